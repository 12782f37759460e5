"""Keypoints for a tracker: read as points where a file holds points, and streamed as goals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from poise.env import Reference
from poise.errors import PoiseError
from poise.jobs.track.placement import Placed
from poise.jobs.tracker import Tracker
from poise.kin.retarget.keypoint_body import PointBody
from poise.kin.retarget.keypoint_stream import KeypointStream, StreamConfig
from poise.motion import Clip
from poise.motion.io.numpy.arrays import Archive
from poise.motion.io.points.arrays import array_points
from poise.motion.io.points.c3d import c3d_points
from poise.motion.io.points.csv import csv_points
from poise.motion.io.points.raw import RawPoints, assemble_points
from poise.motion.io.points.trc import trc_points
from poise.motion.io.raw import ReadOptions as Options
from poise.motion.keypoints import Keypoints
from poise.motion.noise import hold_missing
from poise.motion.points import FitConfig, fit_clip

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
    placed: Placed,
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
