"""`poise doctor CLIP`: the faults of a motion, and with --fix the mended motion beside it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from poise.cli.answer import Answer
from poise.cli.console import notes, say, table
from poise.errors import PoiseError
from poise.jobs.keep import may_write

if TYPE_CHECKING:
    from poise.cli.doctor import Options
    from poise.kin import Examination, Fault
    from poise.motion import Clip

#: The figures of the table: key, title, unit, digits.
FIGURES = (
    ("sole_slide_mm_per_s", "sole slide, mean", "mm/s", 0),
    ("penetration_mm", "penetration, mean", "mm", 1),
    ("penetration_max_mm", "penetration, deepest", "mm", 1),
    ("float_mm", "float, mean", "mm", 1),
    ("jerk_m_per_s3", "jerk, mean", "m/s^3", 0),
    ("jerk_max_m_per_s3", "jerk, largest", "m/s^3", 0),
    ("root_step_max_mm", "root's largest step", "mm", 1),
    ("joint_speed_max_rad_per_s", "fastest joint", "rad/s", 1),
)
#: What is said to be worse after a repair: this share more, and as much more as the last digits say.
WORSE, LEAST = 1.1, {"mm/s": 10.0, "mm": 10.0, "m/s^3": 50.0, "rad/s": 1.0}
#: How far (mm) the root moves before it is said.
TOLD_MM = 10.0
#: Rows of faults of one kind that are printed.
ROWS = 6


def run_on(path: Path, options: Options) -> Answer:
    """Examines, mends and writes where asked to; exit code 0 whatever was found."""
    fix, rest, target = options.fix, options.rest_pose, options.out
    from poise.kin import examine, heal
    from poise.motion.io import check_writable, read_clip, write_clip

    if options.path != "auto" and not fix:
        raise PoiseError("--path needs --fix", hint=f"Write poise doctor {path} --fix -o OUT")
    if (fix or rest) != (target is not None):
        asked = "--fix" if fix or not rest else "--rest-pose"
        hint = f"Write poise doctor {path} {asked} -o OUT"
        raise PoiseError(f"{asked} needs -o OUT" if fix or rest else "-o OUT needs --fix", hint=hint)
    if target is not None:
        check_writable(target)
        may_write(target, options.force, path)
    clip = options.reading.read(path)
    found = examine(clip)
    facts: dict[str, Any] = {"clip": str(path), "frames": clip.frames, "fps": clip.fps}
    facts |= found.to_dict()
    # All that is found holds for the unit and the vertical that were guessed.
    source = clip.skeleton.source
    told = [n for n in source.notes if n in dict(source.evidence).values()]
    notes(told)
    _show(str(path), found)
    outcome = f"{len(found.faults)} faults"
    if target is None:
        return Answer(facts, notes=told, said=told, outcome=outcome)
    free = {"auto": None, "keep": False, "mend": True}[options.path]
    healed = heal(clip, free, found) if fix else clip
    moved = _root_moved(clip, healed)
    if moved is not None and moved["max_mm"] >= TOLD_MM:
        again = (
            ""
            if options.path != "auto"
            else "; --path keep leaves the path, and legs alone hold the feet"
        )
        say(
            f"The root moves by up to {moved['max_mm']:.0f} mm (frame {moved['frame']}), and its path "
            f"ends {moved['end_mm']:.0f} mm from where it ended{again}."
        )
    written, said = healed, ""
    if rest:
        from poise.kin import with_rest_pose

        written, found_from, turned = with_rest_pose(healed)
        frames = f"joints' frames turned by {turned:.0f} degrees"
        said = f"The rest pose is a T-pose now ({found_from}); {frames}."
    write_clip(written, target)
    # What `poise doctor` says of the file that was written: reading may leave frames out, for example.
    again = read_clip(target)
    left = examine(again)
    facts["fixed"] = {"clip": str(target), "frames": again.frames, **left.to_dict()}
    facts["fixed"]["root_moved"] = moved
    facts["fixed"]["detail"] = _detail(clip, healed)
    facts["fixed"]["worse"] = worsened(found, left) if fix else []
    if rest:
        facts["fixed"]["rest_pose"] = said
        say(said)
    if not fix:
        return Answer(facts, {"clip": target}, told, outcome=outcome, said=told)
    _compare(found, left)
    if kept := facts["fixed"]["detail"]:
        told = ", ".join(f"{100 * share:.0f} % at {band}" for band, share in kept.items())
        say(f"Of the movement is left: {told}.")
    if worse := facts["fixed"]["worse"]:
        say(f"Mending made these figures worse: {', '.join(worse)}.")
    if rate := _hidden_rate(found, left):
        say(rate)
    _written(clip, healed, found, left)
    outcome = f"{outcome}, {len(left.faults)} after"
    return Answer(facts, {"clip": target}, told, outcome=outcome, said=told)


def _show(title: str, found: Examination) -> None:
    if not found.judged:
        say("No human body is told by the joints' names, so feet and floor were not judged.")
    if found.travel is not None:
        say(f"{title} {found.travel.words()}: its feet are judged with that travel.")
    if not found.faults:
        say(f"{title}: nothing wrong was found.")
        return
    table(title, ("fault", "joint", "frames", "size", "with --fix"), _rows(found), left=2)


def _rows(found: Examination) -> list[tuple[str, str, str, str, str]]:
    from poise.kin import by_kind
    from poise.kin.doctor.faults import KINDS

    rows = []
    for name, faults in by_kind(found.faults).items():
        kind = KINDS[name]
        worst = sorted(faults, key=lambda f: -f.size)[:ROWS]
        for fault in faults if len(faults) <= ROWS else worst:
            frames = f"{fault.start}" + (f"-{fault.stop}" if fault.stop > fault.start else "")
            mended = kind.repair or "only told"
            rows.append((name, fault.joint or "whole body", frames, _size(fault), mended))
        if len(faults) > ROWS:
            rows.append((name, f"and {len(faults) - ROWS} more", "", "", ""))
    return rows


def _size(fault: Fault) -> str:
    from poise.kin.doctor.faults import KINDS

    unit = KINDS[fault.kind].unit
    number = f"{fault.size:.3g} {unit}".strip()
    return f"{number}, {fault.detail}" if fault.detail else number


def _compare(found: Examination, left: Examination) -> None:
    from poise.kin import by_kind

    rows = []
    before, after = by_kind(found.faults), by_kind(left.faults)
    for name in before | after:
        count = str(len(before.get(name, ()))), str(len(after.get(name, ())))
        rows.append((f"{name}, spells", "", *count))
    for key, title, unit, digits in FIGURES:
        values = [e.figures[key] for e in (found, left)]
        rows.append((title, unit, *("-" if v is None else f"{v:,.{digits}f}" for v in values)))
    table("", ("", "", "before", "after"), rows, left=2)


def worsened(found: Examination, left: Examination) -> list[str]:
    """The figures that are clearly worse after a repair, each with its values before and after."""
    out = []
    for key, title, unit, digits in FIGURES:
        before, after = found.figures[key], left.figures[key]
        if before is None or after is None:
            continue
        if after > max(WORSE * before, before + LEAST[unit]):
            out.append(f"{title} ({before:,.{digits}f} to {after:,.{digits}f} {unit})")
    return out


def _hidden_rate(found: Examination, left: Examination) -> str:
    """That the frame rate is what it was, where the mended motion no longer speaks against it."""
    rates = [next((f.size for f in e.faults if f.kind == "frame rate"), None) for e in (found, left)]
    if rates[0] is None or rates[1] is not None:
        return ""
    return (
        "The frame rate was not changed; the mended motion no longer tells that it is wrong. If it is, "
        f"mend the clip with --fps {rates[0]:g}."
    )


def _root_moved(clip: Clip, healed: Clip) -> dict[str, Any] | None:
    """How far the root is from where it was; None where frames were left out, which move the rest."""
    if clip.frames != healed.frames:
        return None
    import numpy as np

    way = np.linalg.norm(healed.root_pos - clip.root_pos, axis=-1) * 1000
    return {"max_mm": float(way.max()), "frame": int(way.argmax()), "end_mm": float(way[-1])}


def _detail(clip: Clip, healed: Clip) -> dict[str, float]:
    """How much of the movement is left by frequency; empty where nothing was changed, or frames were."""
    if clip is healed or clip.frames != healed.frames:
        return {}
    import torch

    from poise.metrics import detail

    return detail(torch.tensor(healed.positions()), torch.tensor(clip.positions()), clip.fps)


def _written(clip: Clip, healed: Clip, found: Examination, left: Examination) -> None:
    if healed is clip:
        say("Nothing had to be mended; written as it was read.")
        return
    dropped = clip.frames - healed.frames
    frames = f", {dropped} repeated frames left out" if dropped else ""
    say(f"{len(found.faults)} faults before, {len(left.faults)} after{frames}.")
