"""Any motion in the coordinates of a body that is there already: moved over, cleaned, on the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from poise.body import Humanoid
from poise.kin import FitReport, RetargetConfig, RetargetReport, place_on_body, retarget
from poise.kin.feet.level import Levelled
from poise.kin.fit import ClipFit
from poise.kin.ground import clip_flights
from poise.motion import Clip

if TYPE_CHECKING:
    from poise.jobs.tracker import Tracker

#: Angles (rad) beyond a joint's range that are worth a sentence.
BEYOND = math.radians(1.0)


@dataclass(frozen=True, eq=False)
class Placed:
    """A motion on a tracker's body.

    source: as it came. clip: on the body's skeleton, at the source's rate. qpos: `(T, 7 + n)` at the
    control rate, on the floor. report: what fitting did. moved: how it was retargeted, None where it is
    on the body's skeleton already. level: how its feet were turned to stand flat. notes: what else is to
    be said.
    """

    source: Clip
    clip: Clip
    qpos: np.ndarray
    report: FitReport
    moved: RetargetReport | None
    level: Levelled
    notes: tuple[str, ...]


def place(clip: Clip, tracker: Tracker) -> Placed:
    """The motion on the tracker's body; a cycle is tracked once.

    Raises:
        PoiseError: a skeleton that is no human's, or a clip shorter than three control steps.
    """
    humanoid, rate = tracker.humanoid, tracker.config.sim.control_hz
    clip = clip.replaced(cyclic=False)
    on = place_on_body(clip, humanoid.table, tracker.example, rate, near=humanoid)
    flights = clip_flights(on.moved, humanoid.table)
    fit = ClipFit(clip.name, clip.fps, flights, on.cleaned, None, on.ground, on.joint_error_mm)
    notes = _notes(on.qpos, humanoid, on.retargeting, tracker.config.widens)
    return Placed(clip, on.moved, on.qpos, FitReport((fit,)), on.retargeting, on.level, notes)


def home(motion: Clip, placed: Placed, tracker: Tracker) -> Clip:
    """A motion of the body on the skeleton that came in, at its size.

    Joints that the body does not have, such as fingers, move as they did in the source.
    """
    motion = placed.level.off(motion)
    if placed.moved is None:
        return motion
    config = RetargetConfig(scale=1.0 / placed.moved.scale)
    back, report = retarget(motion, placed.source, config=config, example=tracker.example)
    moved = {row.target for row in report.joints.rows if row.source}
    moved |= {j for _, j in report.joints.direct}
    skeleton, rot = back.skeleton, back.rot.copy()
    # What carries a joint that was moved must stay as it is; parents come before their children.
    carries = set(moved)
    for j in reversed(range(len(skeleton))):
        if j in carries and skeleton.parents[j] >= 0:
            carries.add(skeleton.parents[j])
    own = [j for j in range(len(skeleton)) if j not in carries]
    frames = min(back.frames, placed.source.frames)
    rot[:frames, own] = placed.source.rot[:frames, own]
    return back.replaced(rot=rot, name=placed.source.name)


def _notes(
    qpos: np.ndarray, humanoid: Humanoid, moved: RetargetReport | None, widens: bool
) -> tuple[str, ...]:
    out = []
    # A skeleton with other joints but the same bones is worth no sentence.
    if moved is not None and (abs(moved.scale - 1.0) > 0.005 or moved.direction_deg > 0.05):
        out.append(
            "The clip is on another skeleton than the policy's body: it was retargeted at "
            f"{moved.scale:.2f} of its size, its bones {moved.direction_deg:.1f} degrees off on average."
        )
    low, high = humanoid.model.jnt_range[1:].T
    over = np.maximum(low - qpos[:, 7:], qpos[:, 7:] - high).max(0)
    if (over > BEYOND).any():
        worst, many = int(over.argmax()), int((over > BEYOND).sum())
        which = f"{many} joints go" if many > 1 else "One joint goes"
        fate = ", which is widened" if widens else ""
        out.append(
            f"{which} beyond the range of the policy's body{fate}, most "
            f"{humanoid.hinges[worst]} by {math.degrees(over[worst]):.0f} degrees."
        )
    return tuple(out)
