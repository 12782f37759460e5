"""Any motion in the coordinates of a body that is there already: moved over, cleaned, on the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from poise.body import Humanoid
from poise.kin import FitReport, Kinematics, RetargetConfig, RetargetReport, retarget
from poise.kin.coords import clip_to_qpos
from poise.kin.doctor.clean import CleanReport, clean_clip
from poise.kin.feet.level import Levelled, level_feet
from poise.kin.ground import GroundFit, clip_flights, fit_ground
from poise.kin.hinges import within_turns
from poise.motion import Clip, resample

if TYPE_CHECKING:
    from poise.jobs.track.policy import Tracker

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
    known = clip.skeleton.source.ground_m is not None
    made, moved = clip, None
    if not clip.skeleton.same_bones(humanoid.skeleton):
        made, moved = retarget(clip, tracker.example)
    mended, found = clean_clip(made)
    table = humanoid.table
    level = level_feet(mended, table)
    qpos = within_turns(clip_to_qpos(resample(level.onto(mended), rate), table), humanoid)
    qpos, ground = fit_ground(qpos, table, rate, known=known)
    report = _report(made, qpos, humanoid, rate, found, ground)
    notes = _notes(qpos, humanoid, moved, tracker.config.widens)
    return Placed(clip, made, qpos, report, moved, level, notes)


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


def _report(
    clip: Clip, qpos: np.ndarray, humanoid: Humanoid, rate: float, found: CleanReport, ground: GroundFit
) -> FitReport:
    table = humanoid.table
    here = Kinematics(table)(torch.tensor(qpos)).pos.numpy()
    there = resample(clip, rate).positions()[:, [r.joint for r in table.rows]]
    # As they lie about the root, since setting the motion on the floor is no error.
    here, there = here - here[:, :1], there - there[:, :1]
    error = float(np.linalg.norm(here - there, axis=-1).mean() * 1000)
    speeds = np.abs(np.diff(qpos[:, 7:], axis=0)).max(0) * rate
    fastest = (humanoid.hinges[int(speeds.argmax())], float(speeds.max()))
    one = ((clip.name,), (clip.fps,), (clip_flights(clip, table),), (found,), (None,), (ground,))
    return FitReport(*one, (error,), (), (), fastest)


def _notes(
    qpos: np.ndarray, humanoid: Humanoid, moved: RetargetReport | None, widens: bool
) -> tuple[str, ...]:
    out = []
    if moved is not None:
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
