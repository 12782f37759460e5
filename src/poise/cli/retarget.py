"""`poise retarget`: a motion on another skeleton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from poise.cli.console import Answer, say, table
from poise.cli.options import Flag, Reading
from poise.errors import PoiseError
from poise.jobs.keep import may_write

if TYPE_CHECKING:
    from poise.kinematics import RetargetReport


@dataclass(frozen=True)
class Options:
    """Move a clip onto another human skeleton: joints are matched by their names, steps scaled by the
    legs, standing feet kept standing. A tremble is taken off first, unless --raw says to keep it."""

    clip: Annotated[Positional[Path], arg(metavar="CLIP")]
    """The motion file."""
    onto: Annotated[Path, arg(metavar="FILE")]
    """Any motion file with the skeleton that shall move, or an ASF skeleton alone."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="OUT")]
    """The motion file to write; its suffix names the format (.bvh)."""
    map: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="JOINT=JOINT")] = ()
    """A joint of CLIP and the joint that it moves, such as LeftArm=upperarm_l; or a joint and its part,
    such as left_upper_arm=upperarm_l."""
    onto_skeleton: Annotated[Path | None, arg(metavar="ASF", help_behavior_hint="")] = None
    """The ASF skeleton where FILE is an AMC."""
    contacts: Flag = True
    """Do not hold standing feet and hands where the clip has them."""
    force: Flag = False
    """Write over files that are there."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Reads both files, moves the motion over, writes, says what was matched and measured."""
    from poise.formats import read_skeleton, write_clip
    from poise.kinematics import RetargetConfig, retarget, without_noise

    out = options.out
    may_write(out, options.force, options.clip, options.onto)
    mapping = pairs(options.map)
    clip = options.reading.read(options.clip)
    onto = read_skeleton(options.onto, options.onto_skeleton)
    config = RetargetConfig(contacts=options.contacts, clear=options.contacts)
    calm, cleaned = without_noise(clip)
    made, report = retarget(calm, onto, mapping, config)
    write_clip(made, out)
    show(report)
    say(f"{made.frames} frames at {made.fps:.5g} fps, {len(made.skeleton)} joints")
    # Both files' guesses (unit, vertical, ...) decide what is written.
    guessed = [*clip.skeleton.source.notes]
    guessed += [f"{options.onto.name}: {n}" for n in onto.skeleton.source.notes]
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
