"""Any motion in the coordinates of a body that is there already; keypoints as streamed goals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env import Reference
from poise.errors import PoiseError
from poise.formats.arrays import Archive
from poise.formats.c3d import c3d_points
from poise.formats.point_arrays import array_points
from poise.formats.point_fit import FitConfig, fit_clip
from poise.formats.point_raw import RawPoints, assemble_points
from poise.formats.point_tables import csv_points, trc_points
from poise.formats.raw import ReadOptions as Options
from poise.jobs.tracker import Tracker
from poise.kinematics import FitReport, RetargetConfig, RetargetReport, place_on_body, retarget
from poise.kinematics.feet import Levelled
from poise.kinematics.fit import ClipFit
from poise.kinematics.forward import Kinematics
from poise.kinematics.rate import judge_rate
from poise.kinematics.repair.faults import Fault, read_faults
from poise.kinematics.retargeting.keypoint_goal import KeypointStream, PointBody, StreamConfig
from poise.metrics import mpjpe_global, mpjpe_root
from poise.motion import Clip, shifted
from poise.motion.keypoints import Keypoints
from poise.motion.noise import hold_missing
from poise.motion.rotations import quat_between, quat_mul

#: Angles (rad) beyond a joint's range that are worth a sentence.
BEYOND = math.radians(1.0)
#: How far (m) the root may be from the file's without a word.
TOLD_M = 0.02


@dataclass(frozen=True, eq=False)
class PlacedMotion:
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


def place(clip: Clip, tracker: Tracker) -> PlacedMotion:
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
    return PlacedMotion(
        clip, on.calm, on.moved, on.qpos, FitReport((fit,)), on.retargeting, on.level, notes
    )


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


def place_all(clips: Sequence[Clip], tracker: Tracker) -> list[PlacedMotion]:
    """Motions on the tracker's body between which recovery motions can lead, in one world, each at its
    own place, all on the first one's skeleton.

    The body's world is as much larger as the body, about the start of the first: that is how `home`
    makes it smaller again. Hinges are shifted by whole turns as near to those of a body at ease as
    their ranges let them: a joint that is a turn off would be turned all round on the way.

    Raises:
        PoiseError: see `place`.
    """
    first, out = clips[0], list[PlacedMotion]()
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


def home(motion: Clip, placed: PlacedMotion, tracker: Tracker) -> Clip:
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


#: How the points of a format are read, by the name that its clips bear.
_POINTS: dict[str, Callable[[Path, Options], RawPoints]] = {
    "trc": trc_points,
    "c3d": c3d_points,
    "csv": csv_points,
    "keypoints-npz": lambda path, options: array_points(Archive(path), path, options),
}


def points_of(clip: Clip, options: Options) -> Keypoints | None:
    """The keypoints of the file that a clip was read from, None where it holds no keypoints."""
    source = clip.skeleton.source
    if source.format not in _POINTS or not source.path:
        return None
    path = Path(source.path)
    return assemble_points(_POINTS[source.format](path, options), options)


def fitted(points: Keypoints, smooth_hz: float | None = None) -> Clip:
    """The clip that the readers make of keypoints."""
    return fit_clip(points, FitConfig(smooth_hz=smooth_hz))


def follow(
    tracker: Tracker,
    placed: PlacedMotion,
    points: Keypoints,
    reference: Reference,
    smooth_hz: float | None = None,
) -> tuple[Reference, list[str]]:
    """The reference of a keypoint policy with goals from the stream of keypoints, and sentences on it.

    The character begins as the fitted clip does; places and velocities of its goals are those that the
    stream gives from what came so far.

    smooth_hz: cut-off of the stream's filter, which sees the past alone; None smooths as much as the
        keypoints tremble.
    """
    if tracker.config.goal != "keypoints":
        what = "The policy follows rotations: it got the clip that was fitted to the keypoints."
        return reference, [what]
    if placed.source.frames != points.frames:
        what = "The keypoints have long gaps: the longest stretch without was fitted and tracked."
        return reference, [what]
    points = _seen(points)
    # The performer is measured on frames without gaps; the stream itself sees them.
    held = points.replaced(positions=hold_missing(points.positions))
    try:
        body = PointBody.calibrate(held, tracker.example, tracker.humanoid.table)
    except PoiseError as problem:
        what = f"The keypoints cannot be followed one by one ({problem.what}): they were fitted."
        return reference, [what]
    config = StreamConfig(smooth_hz or None)
    goals = list(KeypointStream(body, reference.rate_hz, config).follow(points))
    if len(goals) < 2:
        what = "The keypoints give no goals: the clip that was fitted to them was tracked."
        return reference, [what]
    pose = reference.pose
    times = np.array([g.time_s for g in goals])
    at = np.arange(len(pose.pos)) / reference.rate_hz
    inside = torch.tensor((at >= times[0] - 1e-6) & (at <= times[-1] + 1e-6))[:, None, None]

    def between(values: list[np.ndarray]) -> Tensor:
        table = np.stack(values).reshape(len(times), -1)
        columns = [np.interp(at, times, column) for column in table.T]
        return torch.tensor(np.stack(columns, 1)).reshape(pose.pos.shape).to(pose.pos)

    reference = reference.with_pose(
        replace(
            pose,
            pos=torch.where(inside, between([g.pos for g in goals]), pose.pos),
            linvel=torch.where(inside, between([g.linvel for g in goals]), pose.linvel),
        )
    )
    stale = max(g.stale_s for g in goals)
    late = config.lookahead / reference.rate_hz
    lost = f"; the longest gap of a keypoint is {stale:.1f} s" if stale > 0 else ""
    what = f"Each goal comes from the keypoints up to {late * 1000:.0f} ms after it alone{lost}."
    return reference, [what]


def _seen(points: Keypoints) -> Keypoints:
    """Without those that are missing in every frame."""
    kept = np.flatnonzero(~points.missing.all(0))
    names = tuple(points.names[k] for k in kept)
    return points.replaced(names=names, positions=points.positions[:, kept], confidence=None)


@dataclass(frozen=True)
class Clean:
    """An input with noise, and the character that followed it, beside the motion without noise.

    noise_mm: mean distance of the bodies in the input. off_mm: that of the character, up to where it
    failed. succeeded: whether the character stayed within 0.5 m of the motion without noise.
    """

    noise_mm: float
    off_mm: float
    succeeded: bool

    def sentence(self) -> str:
        """The figures in words."""
        return (
            f"The score is that against the input with noise, which moved the bodies by "
            f"{self.noise_mm:.0f} mm on average; the character is {self.off_mm:.0f} mm from the motion "
            "without noise."
        )


@dataclass(frozen=True)
class BesideRaw:
    """mpjpe_mm, mpjpe_global_mm: the character's error beside what came in, up to where it failed; NaN
    where that is not known. noise: the largest that was taken off."""

    mpjpe_mm: float
    mpjpe_global_mm: float
    noise: Fault

    @property
    def figures(self) -> dict[str, float]:
        """The score card's `raw`."""
        return {
            "mpjpe_mm": self.mpjpe_mm,
            "mpjpe_global_mm": self.mpjpe_global_mm,
            "noise_mm": self.noise.size,
            "noise_hz": math.nan if self.noise.hz is None else self.noise.hz,
        }

    def sentence(self) -> str:
        """The motion that the score is against, in words."""
        beside = ""
        if math.isfinite(self.mpjpe_mm):
            beside = f"; the character is {self.mpjpe_mm:.0f} mm from the motion with it"
        return f"The score is that against the motion without its tremble{beside}."


def beside_raw(
    tracker: Tracker, motion: Clip | Keypoints, placed: PlacedMotion, sim: Tensor, judged: Tensor
) -> BesideRaw | None:
    """The character `sim (T, B, 3)` m in the frames `judged (T)`, None where no tremble was taken off.

    motion: what was placed, keypoints where it came as such.
    """
    of_clip = [f for f in placed.report.clips[0].clean.noise if f.kind == "tremble"]
    noise = [*noise_read(placed.source), *of_clip]
    if not noise:
        return None
    worst = max(noise, key=lambda f: f.size)
    if isinstance(motion, Keypoints):
        came = fitted(replace(motion, source=replace(motion.source, raw=True)))
    elif of_clip:
        came = motion.replaced(skeleton=motion.skeleton.with_source(raw=True))
    else:
        # The keypoints that a clip was made of are gone.
        return BesideRaw(math.nan, math.nan, worst)
    pos = Kinematics(tracker.humanoid.table)(torch.tensor(place(came, tracker).qpos)).pos.to(sim)
    # Samples that jump at an end of keypoints may have cut some frames off.
    frames = min(len(pos), len(sim))
    here, there, kept = sim[:frames], pos[:frames], judged[:frames]
    local, whole = (float(of(here, there)[kept].mean()) for of in (mpjpe_root, mpjpe_global))
    return BesideRaw(local, whole, worst)
