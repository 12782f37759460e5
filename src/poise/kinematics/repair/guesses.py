"""Guesses about a clip: each value with its evidence and how to state it instead."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from poise.body import Anatomy
from poise.errors import PoiseError
from poise.kinematics.rate import RateJudgement, judge_rate
from poise.kinematics.repair.support import SOLE_M, FloorPoints, anatomy_of, support_of
from poise.kinematics.repair.turns import exchanged_sides, neutral_pose, side_votes
from poise.motion import Clip, find_roles, ground_shift
from poise.motion.roles import BY_PLACE

_UNITS = {1.0: "metres", 0.01: "centimetres", 0.001: "millimetres", 0.0254: "inches", 0.1: "decimetres"}
_WORDS = {"feet": "where the feet point", "knees": "where the knees bend", "travel": "where it goes"}


@dataclass(frozen=True)
class GuessedValue:
    """what: up, unit, fps, rest pose, sides, feet or ground. value: plain, m and frames/s where numbers.

    evidence: why, in a sentence without its full stop. override: what to write to state it instead.
    """

    what: str
    value: str | float | None
    evidence: str
    override: str

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


def find_guesses(clip: Clip) -> list[GuessedValue]:
    """All guesses about a clip: those made when it was read, and those made of its body."""
    source, anatomy = clip.skeleton.source, anatomy_of(clip)
    support = support_of(clip, anatomy)
    why = dict(source.evidence)
    unit = _UNITS.get(source.unit_m, f"{source.unit_m:.6g} m")
    made = "The clip was made in code" if source.path is None else "The format itself states it"
    return [
        GuessedValue("up", source.up_axis, why.get("up", made), "--up Y|Z|-Y|-Z"),
        GuessedValue("unit", source.unit_m, why.get("unit", f"The clip is in {unit}"), "--unit METRES"),
        _rate(clip, support, why.get("fps", made)),
        _rest(clip, anatomy),
        _sides(clip, anatomy),
        _feet(clip, anatomy),
        _ground(support),
    ]


def grounded(clip: Clip, support: FloorPoints | None, stated: float | None) -> Clip:
    """The clip moved so that its floor is z = 0: `stated` m high, or as guessed where that is None.

    Raises:
        PoiseError: the floor is to be guessed, but the joints tell no body.
    """
    if stated is None and support is None:
        raise PoiseError(
            "the floor cannot be guessed, since no body is told by its joints",
            clip.skeleton.source.path or clip.name,
            "State its height with --ground METRES",
            code="floor-unknown",
        )
    height = stated if stated is not None else -support.fit.lift_m  # type: ignore[union-attr]
    how = "as stated with --ground" if stated is not None else "as guessed from its soles"
    notes = (*clip.skeleton.source.notes, f"The floor was moved from {height:+.3f} m to 0, {how}")
    skeleton = clip.skeleton.with_source(notes=notes, ground_m=height)
    return ground_shift(clip.replaced(skeleton=skeleton), -height)


def _rate(clip: Clip, support: FloorPoints | None, why: str) -> GuessedValue:
    judged = RateJudgement(clip.fps) if support is None else judge_rate(clip)
    if judged.likely is not None:
        why += f"; but {judged.why()}: likely it has {judged.likely:g} frames per second"
    elif judged.fall is not None:
        why += f"; in flight the body falls with {judged.fall:.1f} m/s^2, which agrees"
    override = "--fps F" if judged.likely is None else f"--fps {judged.likely:g}"
    return GuessedValue("fps", clip.fps, why, override)


def _rest(clip: Clip, anatomy: Anatomy) -> GuessedValue:
    override = "nothing needs it; for other tools poise doctor CLIP --rest-pose -o OUT makes a T-pose"
    dropped = next((n for n in clip.skeleton.source.notes if "rest pose that was put" in n), "")
    more = f"; {dropped[0].lower()}{dropped[1:]}" if dropped else ""
    if not anatomy.parts:
        return GuessedValue("rest pose", None, f"No human body is told by the joints{more}", override)
    if not neutral_pose(clip, anatomy)[1]:
        why = "With all rotations at zero the ankles are not below the hips: each joint's mean rotation"
        return GuessedValue(
            "rest pose", "folded", f"{why} over the clip is taken as neutral{more}", override
        )
    rest = clip.skeleton.rest_positions()
    upper, hand = anatomy.of("upper_arm", "left")[0], anatomy.of("hand", "left")[0]
    arm = rest[hand] - rest[upper]
    down = math.degrees(math.asin(float(np.clip(-arm[2] / max(np.linalg.norm(arm), 1e-9), -1, 1))))
    name = "T-pose" if abs(down) < 20 else "A-pose" if 20 <= down < 70 else "arms down"
    name = name if down > -20 else "arms up"
    why = f"With all rotations at zero the ankles are below the hips and the arms {_lean(down)}"
    return GuessedValue("rest pose", name, why + more, override)


def _lean(down: float) -> str:
    return f"hang by {down:.0f} degrees" if down >= 1 else f"rise by {max(0.0, -down):.0f} degrees"


def _sides(clip: Clip, anatomy: Anatomy) -> GuessedValue:
    votes = side_votes(clip, anatomy)
    shares = ", ".join(f"{_WORDS[k]} {50 + 50 * v:.0f} %" for k, v in votes.items())
    if exchanged_sides(clip, anatomy):
        why = f"The joints named left lie on the body's right, so names or axes are mirrored ({shares})"
        return GuessedValue("sides", "exchanged", why, "--swap-sides")
    if not votes:
        return GuessedValue(
            "sides", None, "Neither feet nor knees tell where the body faces", "--swap-sides"
        )
    why = f"Frames in which the joints named left lie on the left, told by {shares}"
    return GuessedValue("sides", "as named", why, "--swap-sides")


def _feet(clip: Clip, anatomy: Anatomy) -> GuessedValue:
    names, feet, toes = clip.skeleton.names, anatomy.of("foot"), [j for _, j in anatomy.toes]
    override = "rename the joints in the file (LeftFoot, RightFoot)"
    if not feet:
        return GuessedValue("feet", None, "No pair of feet is told by the joints' names", override)
    tips = [j for j, _ in clip.skeleton.ends]
    ends = [f"toes '{names[j]}'" for j in toes] or [
        f"a bone tip of '{names[j]}'" for j in feet if j in tips
    ]
    sure = {row.joint: row.confidence for row in find_roles(clip.skeleton).rows}
    named = all(sure.get(j, 0.0) > BY_PLACE for j in feet)
    how = "Named so and at" if named else "Not told by their names, but by their place at"
    why = f"{how} the ends of three-joint legs; soles reach to {' and '.join(ends)}"
    return GuessedValue(
        "feet", ", ".join(names[j] for j in feet), why if ends else why.split(";")[0], override
    )


def _ground(support: FloorPoints | None) -> GuessedValue:
    override = "--ground METRES, or --ground auto to move this guess to 0"
    if support is None:
        return GuessedValue(
            "ground", None, "No body is told by the joints, so no soles either", override
        )
    floor = -support.fit.lift_m
    why = f"Soles that are flat and slow are at {floor * 100:+.1f} cm"
    sure = (
        "clearly off 0"
        if abs(floor) > SOLE_M
        else f"0 within the {SOLE_M * 100:.1f} cm of a guessed sole"
    )
    return GuessedValue("ground", floor, f"{why}: {sure}", override)
