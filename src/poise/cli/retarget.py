"""`poise retarget`: a motion on another skeleton."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from poise.cli.console import Answer, say, table
from poise.cli.options import Flag, Force, Json, Reading
from poise.errors import PoiseError
from poise.jobs.keep import may_write

if TYPE_CHECKING:
    from poise.kinematics import RetargetReport


def run(
    clip: Annotated[Positional[Path], arg(metavar="CLIP")],
    onto: Annotated[Path, arg(metavar="FILE")],
    out: Annotated[Path, arg(aliases=["-o"], metavar="OUT")],
    map: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="JOINT=JOINT")] = (),
    onto_skeleton: Annotated[Path | None, arg(metavar="ASF", help_behavior_hint="")] = None,
    contacts: Flag = True,
    hands: Literal["direction", "place"] = "direction",
    force: Force = False,
    json: Json = False,
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Move a clip onto another human skeleton: joints are matched by their names, steps scaled by the
    legs, standing feet kept standing. A tremble is taken off first, unless --raw says to keep it.

    Args:
        clip: the motion file.
        onto: any motion file with the skeleton that shall move, or an ASF skeleton alone.
        out: the motion file to write; its suffix names the format (.bvh).
        map: a joint of CLIP and the joint that it moves, such as LeftArm=upperarm_l; or a joint and its
            part, such as left_upper_arm=upperarm_l.
        onto_skeleton: the ASF skeleton where FILE is an AMC.
        contacts: do not hold standing feet and hands where the clip has them.
        hands: with direction arms point where those of the clip point; with place hands stay where they
            are, from the hips, over the floor and on what they touch, and elbows bend to it.
    """
    from poise.formats import read_skeleton, write_clip
    from poise.kinematics import RetargetConfig, retarget, without_noise

    may_write(out, force, clip, onto)
    mapping = pairs(map)
    source, target = reading.read(clip), read_skeleton(onto, onto_skeleton)
    config = RetargetConfig(contacts=contacts, clear=contacts, hands=hands)
    calm, cleaned = without_noise(source)
    made, report = retarget(calm, target, mapping, config)
    write_clip(made, out)
    show(report)
    say(f"{made.frames} frames at {made.fps:.5g} fps, {len(made.skeleton)} joints")
    # Both files' guesses (unit, vertical, ...) decide what is written.
    guessed = [*source.skeleton.source.notes]
    guessed += [f"{onto.name}: {n}" for n in target.skeleton.source.notes]
    said = [*guessed, *cleaned.noise_sentences(), *report.sentences()]
    return Answer(report.to_dict(), {"clip": out}, said)


def pairs(texts: Sequence[str]) -> dict[str, str]:
    """{"LeftArm": "upperarm_l"} from ("LeftArm=upperarm_l",)."""
    out: dict[str, str] = {}
    for text in texts:
        a, equals, b = (x.strip() for x in text.partition("="))
        if not (equals and a and b):
            raise PoiseError(
                f"--map needs JOINT=JOINT, got '{text}'",
                hint="Write --map LeftArm=upperarm_l",
                code="option-malformed",
            )
        if out.get(a, b) != b:
            raise PoiseError(
                f"--map gives '{a}' both '{out[a]}' and '{b}' to move", code="joint-mapped-twice"
            )
        out[a] = b
    return out


def show(report: RetargetReport) -> None:
    """The table of joints that are moved."""
    joints = report.joints
    source, target = joints.source.skeleton.names, joints.target.skeleton.names
    rows = [
        (
            row.role.replace("_", " ") or "-",
            ", ".join(source[j] for j in row.source),
            target[row.target],
            f"{row.confidence:.1f}",
            row.evidence,
        )
        for row in joints.rows
        if row.source
    ]
    table("", ("part", "moved by", "joint", "sure", "why"), rows, left=5)
