"""Noise that moves what is seen: jitter, outliers, drift, a wrong depth.

The defaults were measured where there is data.
Pose2Sim, four cameras, 21 triangulated OpenPose keypoints at 60 Hz, raw against its own Butterworth
pair: 7 mm off at the median, 25 at the 90th and 64 at the 99th percentile; 5.9 and 5.3 mm of deviation
along two axes and 12.3 along the third; no correlation between frames (-0.08 at one frame) and little
between points (0.11). That is 3 mm per coordinate, twice as much along one axis, and for a sixth of the
samples 35 mm more (`TRIANGULATED`; its quantiles are within 25 % of those).
Rokoko Vision, a dance from one phone: smoothed (0.16 mm white at 100 Hz). At 30 Hz 7.3, 3.3 and 1.6 mm
lie above 4, 6 and 8 Hz, where marker captures have 1.0, 0.6 and 0.3; 20 mm per coordinate with a
correlation time of 60 ms have 6.3, 3.2 and 1.6 mm there. Its floor level wanders by 47 mm, where marker
captures' does by 2 to 11. Depth has no truth in that data: 3 % of the distance is an assumption.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.noise.kinds import Noise, Points, Pose, smooth_path, wandering_path
from poise.spatial import quat_mul, rotvec_to_quat

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Jitter(Noise):
    """Every point trembles by `sigma_m` m per coordinate, each on its own, correlated over `tau_s` s.

    axis, axis_ratio: a direction along which it is larger, such as a camera's. On a pose the root
    trembles by `sigma_m` and every joint turns by `sigma_rad` rad per axis (20 mm at the end of a
    forearm and hand).
    """

    sigma_m: float = 0.02
    sigma_rad: float = 0.05
    tau_s: float = 0.06
    axis: Vector = (1.0, 0.0, 0.0)
    axis_ratio: float = 1.0

    def points(self, track: Points, rng: np.random.Generator) -> Points:
        path = smooth_path(rng, len(track.pos), track.pos.shape[1:], track.fps, self.tau_s)
        return track._replace(pos=track.pos + self._stretched(path))

    def pose(self, track: Pose, rng: np.random.Generator) -> Pose:
        frames, joints = track.rot.shape[:2]
        moves = smooth_path(rng, frames, (3,), track.fps, self.tau_s)
        turns = smooth_path(rng, frames, (joints, 3), track.fps, self.tau_s)
        turns *= self.sigma_rad * self.strength
        root_pos = track.root_pos + self._stretched(moves)
        return track._replace(root_pos=root_pos, rot=turned(track.rot, turns))

    def _stretched(self, path: np.ndarray) -> np.ndarray:
        way = unit(self.axis, "axis")
        along = (path @ way)[..., None] * way
        return self.sigma_m * self.strength * (path + (self.axis_ratio - 1.0) * along)


@dataclass(frozen=True, kw_only=True)
class Outliers(Noise):
    """A share of the samples is `size_m` m (rms of the norm) farther off, each on its own.

    On a pose a joint turns by `size_rad` instead. Strength scales the share.
    """

    share: float = 0.16
    size_m: float = 0.035
    size_rad: float = 0.1

    def points(self, track: Points, rng: np.random.Generator) -> Points:
        frames, count, _ = track.pos.shape
        off = self._off(rng, frames, count, self.size_m)
        return track._replace(pos=track.pos + off)

    def pose(self, track: Pose, rng: np.random.Generator) -> Pose:
        frames, joints = track.rot.shape[:2]
        return track._replace(rot=turned(track.rot, self._off(rng, frames, joints, self.size_rad)))

    def _off(self, rng: np.random.Generator, frames: int, count: int, size: float) -> np.ndarray:
        hit = rng.random((frames, count)) < self.share * self.strength
        return np.where(hit[..., None], rng.standard_normal((frames, count, 3)) * size / 3**0.5, 0.0)


@dataclass(frozen=True, kw_only=True)
class Drift(Noise):
    """The whole body wanders by `sigma_m` m along x, y and z, with a memory of `tau_s` s."""

    sigma_m: Vector = (0.045, 0.045, 0.045)
    tau_s: float = 0.8

    def points(self, track: Points, rng: np.random.Generator) -> Points:
        return track._replace(pos=track.pos + self._path(rng, len(track.pos), track.fps)[:, None])

    def pose(self, track: Pose, rng: np.random.Generator) -> Pose:
        path = self._path(rng, len(track.root_pos), track.fps)
        return track._replace(root_pos=track.root_pos + path)

    def _path(self, rng: np.random.Generator, frames: int, fps: float) -> np.ndarray:
        path = wandering_path(rng, frames, (3,), fps, self.tau_s)
        return self.strength * np.array(self.sigma_m) * path


@dataclass(frozen=True, kw_only=True)
class WrongDepth(Noise):
    """Distances along the camera's axis are wrong by a factor 1 + e: p' = p + e ((p - c) . a) a.

    e wanders by `sigma` with a memory of `tau_s` s, about `bias`. camera: its place c in m, by default
    4 m in front of where the body begins, looking along `axis` a. On a pose it moves the root.
    """

    sigma: float = 0.03
    bias: float = 0.0
    tau_s: float = 0.5
    axis: Vector = (1.0, 0.0, 0.0)
    camera: Vector | None = None

    def points(self, track: Points, rng: np.random.Generator) -> Points:
        return track._replace(pos=self._moved(track.pos, rng, track.fps))

    def pose(self, track: Pose, rng: np.random.Generator) -> Pose:
        moved = self._moved(track.root_pos[:, None], rng, track.fps)[:, 0]
        return track._replace(root_pos=moved)

    def _moved(self, pos: np.ndarray, rng: np.random.Generator, fps: float) -> np.ndarray:
        way = unit(self.axis, "axis")
        wrong = self.bias + self.sigma * wandering_path(rng, len(pos), (), fps, self.tau_s)
        if self.camera is None:
            seen = pos[~np.isnan(pos).any((1, 2))]
            begin = seen[0].mean(0) if len(seen) else np.zeros(3)
            camera = begin - 4.0 * way
        else:
            camera = np.array(self.camera)
        depth = (pos - camera) @ way
        return pos + (self.strength * wrong)[:, None, None] * depth[..., None] * way


def unit(axis: Vector, what: str) -> np.ndarray:
    """The unit vector along `axis`; one without length is refused."""
    length = float(np.linalg.norm(axis))
    if not length > 1e-9:
        raise PoiseError(f"the {what} must have a length, got {axis}")
    return np.array(axis) / length


def turned(rot: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Rotations `(..., 4)` turned in their own frames by rotation vectors `(..., 3)` rad."""
    return quat_mul(torch.tensor(rot), rotvec_to_quat(torch.tensor(turns))).numpy()
