"""Any motion in the coordinates of a body that is there already: moved over, cleaned, on the floor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from poise.body import Humanoid
from poise.kin import FitReport, RetargetConfig, RetargetReport, place_on_body, retarget
from poise.kin.doctor.faults import Fault, read_faults
from poise.kin.feet.level import Levelled
from poise.kin.fit import ClipFit
from poise.kin.rate.judge import judge_rate
from poise.motion import Clip, shifted
from poise.spatial import quat_between, quat_mul

if TYPE_CHECKING:
    from poise.jobs.tracker import Tracker

#: Angles (rad) beyond a joint's range that are worth a sentence.
BEYOND = math.radians(1.0)
#: How far (m) the root may be from the file's without a word.
TOLD_M = 0.02


@dataclass(frozen=True, eq=False)
class Placed:
    """A motion on a tracker's body.

    source: as it came. calm: what is followed in its place, on its own skeleton (`without_noise`).
    clip: on the body's skeleton, at the source's rate. qpos: `(T, 7 + n)` at the control rate, on the
    floor. report: what fitting did. moved: how it was retargeted, None where it is on the body's
    skeleton already. level: how its feet were turned to stand flat. notes: what else is to be said.
    """

    source: Clip
    calm: Clip
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
    on = place_on_body(clip, humanoid.table, tracker.example, rate, how=tracker.onto, near=humanoid)
    fit = ClipFit(clip.name, judge_rate(clip), on.cleaned, None, on.ground, on.joint_error_mm)
    notes = _notes(on.qpos, humanoid, on.retargeting, tracker.config.widens)
    notes = (*_read_noise(clip), *on.cleaned.noise_sentences(), *_root_told(clip, on.calm), *notes)
    return Placed(clip, on.calm, on.moved, on.qpos, FitReport((fit,)), on.retargeting, on.level, notes)


def _read_noise(clip: Clip) -> tuple[str, ...]:
    """Sentences on the noise that reading took off a clip's keypoints."""
    return tuple(
        f"The keypoints tremble by {f.size:.0f} mm {f.detail}: the tremble is taken off."
        for f in noise_read(clip)
    )


def _root_told(clip: Clip, calm: Clip) -> tuple[str, ...]:
    """A sentence on the root of what is followed in a clip's place, where it is elsewhere."""
    most = 0.0 if calm is clip else float(np.linalg.norm(calm.root_pos - clip.root_pos, axis=-1).max())
    if most < TOLD_M:
        return ()
    return (f"The root of the motion that is followed is up to {most * 1000:.0f} mm from the file's.",)


def noise_read(clip: Clip) -> list[Fault]:
    """The noise that reading took off a clip's keypoints; none where it had none."""
    return [f for f in read_faults(clip) if f.kind == "tremble"]


def place_all(clips: Sequence[Clip], tracker: Tracker) -> list[Placed]:
    """Motions on the tracker's body between which recovery motions can lead, in one world, each at its
    own place, all on the first one's skeleton.

    The body's world is as much larger as the body, about the start of the first: that is how `home`
    makes it smaller again. Hinges are shifted by whole turns as near to those of a body at ease as
    their ranges let them: a joint that is a turn off would be turned all round on the way.

    Raises:
        PoiseError: see `place`.
    """
    first, out = clips[0], list[Placed]()
    for clip in clips:
        notes: tuple[str, ...] = ()
        if not clip.skeleton.same_bones(first.skeleton):
            clip = retarget(clip, first)[0]
            notes = (f"The clip is on another skeleton than {first.name}: it was retargeted onto that.",)
        p = place(clip, tracker)
        larger = (out or [p])[0].moved
        away = (clip.root_pos[0] - first.root_pos[0]) * (larger.scale - 1.0 if larger else 0.0)
        qpos = _unwound(p.qpos, tracker)
        qpos[:, :2] += away[:2]
        moved = shifted(p.clip, (away[0], away[1], 0.0))
        out.append(replace(p, clip=moved, qpos=qpos, notes=(*notes, *p.notes)))
    return out


def _unwound(qpos: np.ndarray, tracker: Tracker) -> np.ndarray:
    """A motion `(T, 7 + n)` with hinges as near to those at ease as whole turns bring them."""
    out, angles = qpos.copy(), qpos[:, 7:]
    if tracker.recovery_clips is None:
        return out
    near = angles - 2 * np.pi * np.round(
        (angles.mean(0) - tracker.recovery_clips.ease[7:].numpy()) / (2 * np.pi)
    )
    low, high = tracker.humanoid.model.jnt_range[1:].T
    fits = (near.min(0) >= low) & (near.max(0) <= high)
    out[:, 7:] = np.where(fits, near, angles)
    return out


def home(motion: Clip, placed: Placed, tracker: Tracker) -> Clip:
    """A motion of the body on the skeleton that came in, at its size.

    Joints that the body does not have, such as fingers, move as they did in the source.
    """
    motion = placed.level.off(motion)
    if placed.moved is None:
        return motion
    config = replace(tracker.onto or RetargetConfig(), scale=1.0 / placed.moved.scale)
    source = placed.calm
    back, report = retarget(motion, source, config=config, example=tracker.example)
    moved = {row.target for row in report.joints.rows if row.source}
    moved |= {j for _, j in report.joints.direct}
    skeleton, rot = back.skeleton, back.rot.copy()
    # What carries a joint that was moved must stay as it is; parents come before their children.
    carries = set(moved)
    for j in reversed(range(len(skeleton))):
        if j in carries and skeleton.parents[j] >= 0:
            carries.add(skeleton.parents[j])
    own = [j for j in range(len(skeleton)) if j not in carries]
    frames = min(back.frames, source.frames)
    rot[:frames, own] = source.rot[:frames, own]
    back = back.replaced(rot=rot, name=source.name)
    still = [report.joints.target.joint(role) for role in config.rigid]
    return _turned_under(back, source, [j for j in still if j is not None])


def _turned_under(clip: Clip, source: Clip, joints: Sequence[int]) -> Clip:
    """The clip with some joints turned as in the source, while those that hang on them keep their
    turns in the world."""
    rot, parents = torch.tensor(clip.rot), clip.skeleton.parents
    frames = min(clip.frames, source.frames)
    for j in joints:
        own = torch.tensor(source.rot[:frames, j])
        turn = quat_between(own, rot[:frames, j])
        rot[:frames, j] = own
        for child in (c for c, p in enumerate(parents) if p == j):
            rot[:frames, child] = quat_mul(turn, rot[:frames, child])
    return clip.replaced(rot=rot.numpy())


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
