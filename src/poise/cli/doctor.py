"""`poise doctor`: what works on this machine; `poise doctor CLIP`: what is wrong with a motion."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise import __version__
from poise.cli.console import Answer, notes, out, say, table
from poise.cli.options import Flag, Force, Json, Reading, each
from poise.errors import PoiseError
from poise.jobs.keep import claimed, may_write
from poise.machine import cores

if TYPE_CHECKING:
    from poise.kinematics import Examination, Fault
    from poise.motion import Clip


State = Literal["ok", "missing", "optional"]
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "firefox")
_SPEED_ENVS, _SPEED_S = 64, 0.5


@dataclass(frozen=True)
class Check:
    """One line: what was looked for, whether it is there, what was found, what to do if not."""

    name: str
    state: State
    found: str
    todo: str = ""


@dataclass(frozen=True)
class Options:
    """Say what is wrong with a motion, and mend it; without a clip, what works on this machine."""

    clip: Annotated[Positional[Path | None], arg(metavar="[CLIP]", help_behavior_hint="")] = None
    """A motion file or a folder of them: trembling, sliding, floating, sinking, jumps, flips, bones."""
    fix: Flag = False
    """Mend what kinematics can mend, and write the result to OUT."""
    path: Literal["auto", "keep", "mend"] = "auto"
    """With --fix: keep leaves the root's path; mend takes off it what standing feet slip in common; auto
    does so where both feet tell the same drift."""
    rest_pose: Flag = False
    """Write it with a rest pose that other tools understand: a T-pose with all rotations at zero. The
    motion stays; without --fix nothing else is changed."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="")] = None
    """The mended motion on the same skeleton; its suffix names the format. For a folder a folder."""
    force: Force = False
    json: Json = False
    reading: OmitArgPrefixes[Reading] = Reading()


def run(options: Options, argv: Sequence[str]) -> Answer:
    """For a clip see `run_on`; for the machine exit code 0 if all is there, else 1."""
    if options.clip is not None:
        if not options.clip.is_dir():
            return run_on(options.clip, options)
        o, folder = options, options.out

        def one(path: Path, name: str) -> Answer:
            return run_on(path, replace(o, out=None if folder is None else folder / f"{name}.bvh"))

        with contextlib.nullcontext() if folder is None else claimed(folder):
            return each("doctor", (options.clip,), folder, one)
    if options.fix or options.rest_pose or options.out is not None:
        raise PoiseError(
            "no clip was given", hint="Write poise doctor CLIP --fix -o OUT", code="argument-missing"
        )
    from rich.text import Text

    checks = [check() for check in CHECKS]
    ready = all(c.state != "missing" for c in checks)
    wide = max(len(c.name) for c in checks)
    styles = {"ok": "green", "missing": "bold red", "optional": "yellow"}
    for c in checks:
        todo = f" ({c.todo})" if c.todo else ""
        line = Text.assemble((f"{c.state:<9}", styles[c.state]), f"{c.name:<{wide}}  {c.found}{todo}")
        out().print(line, soft_wrap=True)
    say("This machine is ready." if ready else "Something needed is missing; see above.")
    facts = {"poise": __version__, "ready": ready, "checks": [asdict(c) for c in checks]}
    return Answer(facts, exit_code=0 if ready else 1)


def python() -> Check:
    """Python's version."""
    good = sys.version_info >= (3, 11)
    found = f"{platform.python_version()} ({platform.python_implementation()})"
    return Check("python", "ok" if good else "missing", found, "" if good else "install Python 3.11")


def machine() -> Check:
    """The system, the cores this process may use, the memory."""
    count = cores()
    memory = ""
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        memory = f", {total / 2**30:.1f} GiB of memory"
    named = f"{platform.system()} {platform.machine()}"
    return Check("machine", "ok", f"{named}, {count} core{'' if count == 1 else 's'}{memory}")


def package(module: str, name: str, todo: str, needed: bool = True) -> Callable[[], Check]:
    """A check that `module` can be imported; `name` is its distribution."""

    def check() -> Check:
        absent: State = "missing" if needed else "optional"
        try:
            import_module(module)
        except Exception as problem:
            # A package that is there but broken says so in its own words.
            there = "not installed" if isinstance(problem, ModuleNotFoundError) else str(problem)
            return Check(module, absent, " ".join(there.split())[:120], todo)
        try:
            return Check(module, "ok", metadata.version(name))
        except metadata.PackageNotFoundError:
            return Check(module, "ok", "version unknown")

    return check


def cuda() -> Check:
    """A GPU that torch can use."""
    try:
        import torch
    except ImportError:
        return Check("cuda", "optional", "torch is missing", "install torch first")
    if torch.cuda.is_available():
        name = torch.cuda.get_device_name(0)
        if find_spec("mujoco_warp") is None:
            fix = "pip install 'poise-motion[gpu]' for --device cuda"
            return Check("cuda", "optional", f"{name}, but no mujoco-warp", fix)
        return Check("cuda", "ok", name)
    return Check("cuda", "optional", "no GPU", "everything runs on the CPU as well")


def browser() -> Check:
    """A browser for the reports."""
    found = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if found:
        return Check("browser", "ok", found)
    return Check("browser", "optional", "none found", "open report.html on any other machine")


def cache() -> Check:
    """A folder for what can be made again."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "poise"
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    try:
        with tempfile.TemporaryFile(dir=place):
            return Check("cache", "ok", str(folder))
    except OSError as problem:
        why = f"{folder} cannot be written ({problem.strerror})"
        return Check("cache", "optional", why, "set XDG_CACHE_HOME to a folder that can")


def speed() -> Check:
    """Steps per second of the physics, with the body of the policy that comes with Poise."""
    try:
        import torch

        from poise.jobs.open import open_run
        from poise.sim import CpuBackend, SimConfig, alone

        humanoid = open_run().tracker.humanoid
        backend = CpuBackend(alone(humanoid), _SPEED_ENVS)
    except Exception as problem:
        said = f"{type(problem).__name__}: {problem}"
        return Check("physics", "missing", " ".join(said.split())[:120], "install Poise again")
    qpos = torch.tensor(humanoid.model.qpos0).repeat(_SPEED_ENVS, 1)
    qpos[:, 2] = 1.0
    backend.write(None, qpos, torch.zeros(_SPEED_ENVS, humanoid.model.nv))
    steps, start = 0, time.perf_counter()
    while (spent := time.perf_counter() - start) < _SPEED_S:
        backend.step(SimConfig().substeps)
        steps += _SPEED_ENVS
    fine = bool(torch.isfinite(backend.state.qpos).all())
    backend.close()
    hinges = len(humanoid.hinges)
    found = f"{steps / spent:,.0f} control steps/s with {_SPEED_ENVS} bodies of {hinges} hinges"
    if fine:
        return Check("physics", "ok", found)
    return Check("physics", "missing", "the simulation diverged", "install mujoco again")


CHECKS: tuple[Callable[[], Check], ...] = (
    python,
    machine,
    package("torch", "torch", "pip install torch"),
    package("mujoco", "mujoco", "pip install 'mujoco>=4.0'"),
    package("mujoco.batch", "mujoco", "pip install --upgrade 'mujoco>=4.0'"),
    package("tensorboard", "tensorboard", "pip install tensorboard"),
    speed,
    cache,
    cuda,
    package("mujoco_warp", "mujoco-warp", "pip install mujoco-warp, for physics on a GPU", needed=False),
    browser,
)


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
    from poise.formats import check_writable, read_clip, write_clip
    from poise.kinematics import examine, heal

    if options.path != "auto" and not fix:
        raise PoiseError(
            "--path needs --fix",
            hint=f"Write poise doctor {path} --fix -o OUT",
            code="option-needs-option",
        )
    if (fix or rest) != (target is not None):
        asked = "--fix" if fix or not rest else "--rest-pose"
        hint = f"Write poise doctor {path} {asked} -o OUT"
        raise PoiseError(
            f"{asked} needs -o OUT" if fix or rest else "-o OUT needs --fix",
            hint=hint,
            code="option-needs-option",
        )
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
        from poise.kinematics import with_rest_pose

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
        shares = ", ".join(f"{100 * share:.0f} % at {band}" for band, share in kept.items())
        say(f"Of the movement is left: {shares}.")
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
    from poise.kinematics import by_kind
    from poise.kinematics.repair.faults import KINDS

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
    from poise.kinematics.repair.faults import KINDS

    unit = KINDS[fault.kind].unit
    number = f"{fault.size:.3g} {unit}".strip()
    return f"{number}, {fault.detail}" if fault.detail else number


def _compare(found: Examination, left: Examination) -> None:
    from poise.kinematics import by_kind

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
    from poise.metrics import detail

    return detail(healed.positions(), clip.positions(), clip.fps)


def _written(clip: Clip, healed: Clip, found: Examination, left: Examination) -> None:
    if healed is clip:
        say("Nothing had to be mended; written as it was read.")
        return
    dropped = clip.frames - healed.frames
    frames = f", {dropped} repeated frames left out" if dropped else ""
    say(f"{len(found.faults)} faults before, {len(left.faults)} after{frames}.")
