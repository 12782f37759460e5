"""The kinds of noise: what is seen is moved, lost, taken for something else or late.

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
OpenPose on the four cameras of the Pose2Sim trial gives no confidence to 0.2, 3.2, 5.0 and 7.6 % of its
keypoints, in spells of 1.5 frames at the median and 0.19 s on average at 60 Hz; triangulation of four
cameras loses none. Neither that trial nor Rokoko's video loses a frame or shows exchanged sides: the
shares of those, and the latency, are assumptions. A point that is lost is NaN; a pose, which must be
whole, holds what was last seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.noise.base import Noise, Seen, smooth_path, spell_mask, wandering_path
from poise.spatial import quat_mul, rotvec_to_quat, unwrap_quats

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

    def on(self, seen: Seen, rng: np.random.Generator) -> Seen:
        way, frames = _unit(self.axis), len(seen.pos)
        path = smooth_path(rng, frames, seen.pos.shape[1:], seen.fps, self.tau_s)
        path = path + (self.axis_ratio - 1.0) * (path @ way)[..., None] * way
        pos = seen.pos + self.sigma_m * self.strength * path
        if seen.rot is None:
            return seen._replace(pos=pos)
        turns = smooth_path(rng, frames, (seen.rot.shape[1], 3), seen.fps, self.tau_s)
        return seen._replace(pos=pos, rot=_turned(seen.rot, self.sigma_rad * self.strength * turns))


@dataclass(frozen=True, kw_only=True)
class Outliers(Noise):
    """A share of the samples is `size_m` m (rms of the norm) farther off, each on its own.

    On a pose a joint turns by `size_rad` instead. Strength scales the share.
    """

    share: float = 0.16
    size_m: float = 0.035
    size_rad: float = 0.1

    def on(self, seen: Seen, rng: np.random.Generator) -> Seen:
        size, shape = (self.size_m, seen.pos.shape[:2])
        if seen.rot is not None:
            size, shape = (self.size_rad, seen.rot.shape[:2])
        hit = rng.random(shape) < self.share * self.strength
        off = np.where(hit[..., None], rng.standard_normal((*shape, 3)) * size / 3**0.5, 0.0)
        if seen.rot is None:
            return seen._replace(pos=seen.pos + off)
        return seen._replace(rot=_turned(seen.rot, off))


@dataclass(frozen=True, kw_only=True)
class Drift(Noise):
    """The whole body wanders by `sigma_m` m along x, y and z, with a memory of `tau_s` s."""

    sigma_m: Vector = (0.045, 0.045, 0.045)
    tau_s: float = 0.8

    def on(self, seen: Seen, rng: np.random.Generator) -> Seen:
        path = wandering_path(rng, len(seen.pos), (3,), seen.fps, self.tau_s)
        return seen._replace(pos=seen.pos + (self.strength * np.array(self.sigma_m) * path)[:, None])


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

    def on(self, seen: Seen, rng: np.random.Generator) -> Seen:
        pos, way = seen.pos, _unit(self.axis)
        wrong = self.bias + self.sigma * wandering_path(rng, len(pos), (), seen.fps, self.tau_s)
        if self.camera is None:
            whole = pos[~np.isnan(pos).any((1, 2))]
            begin = whole[0].mean(0) if len(whole) else np.zeros(3)
            camera = begin - 4.0 * way
        else:
            camera = np.array(self.camera)
        depth = (pos - camera) @ way
        return seen._replace(pos=pos + (self.strength * wrong)[:, None, None] * depth[..., None] * way)


@dataclass(frozen=True, kw_only=True)
class Dropouts(Noise):
    """Points are missing for `share` of the time each, in spells of `mean_s` s on average."""

    share: float = 0.04
    mean_s: float = 0.19

    def on(self, seen: Seen, rng: np.random.Generator) -> Seen:
        if seen.rot is None:
            lost = self._lost(rng, seen, seen.pos.shape[1])
            return seen._replace(pos=np.where(lost[..., None], np.nan, seen.pos))
        at = last_seen(self._lost(rng, seen, seen.rot.shape[1]))
        return seen._replace(rot=np.take_along_axis(seen.rot, at[..., None], 0))

    def _lost(self, rng: np.random.Generator, seen: Seen, count: int) -> np.ndarray:
        """`(T, count)`, what is missing when."""
        share = min(self.share * self.strength, 1.0)
        return spell_mask(rng, len(seen.pos), count, seen.fps, share, self.mean_s)


@dataclass(frozen=True, kw_only=True)
class FrameLoss(Dropouts):
    """Whole frames are missing for `share` of the time, in spells of `mean_s` s on average."""

    share: float = 0.03
    mean_s: float = 0.1

    def on(self, seen: Seen, rng: np.random.Generator) -> Seen:
        lost = self._lost(rng, seen, 1)
        if seen.rot is None:
            return seen._replace(pos=np.where(lost[..., None], np.nan, seen.pos))
        at = last_seen(lost)[:, 0]
        return seen._replace(pos=seen.pos[at], rot=seen.rot[at])


@dataclass(frozen=True, kw_only=True)
class SwapSides(Noise):
    """Left is taken for right for `share` of the time, in spells of `mean_s` s, arms and legs apart."""

    share: float = 0.02
    mean_s: float = 0.15

    def on(self, seen: Seen, rng: np.random.Generator) -> Seen:
        values = seen.pos if seen.rot is None else seen.rot
        share = min(self.share * self.strength, 1.0)
        wrong = spell_mask(rng, len(values), 2, seen.fps, share, self.mean_s)
        out = values.copy()
        for left, right, limb in seen.pairs:
            here = wrong[:, 0 if limb == "arm" else 1]
            out[here, left], out[here, right] = values[here, right], values[here, left]
        return seen._replace(pos=out) if seen.rot is None else seen._replace(rot=out)


@dataclass(frozen=True, kw_only=True)
class Latency(Noise):
    """Everything comes `seconds` s late, between frames by interpolation; before, the first frame."""

    seconds: float = 0.1

    def on(self, seen: Seen, rng: np.random.Generator) -> Seen:
        del rng
        late = seen._replace(pos=self._late(seen.pos, seen.fps))
        if seen.rot is None:
            return late
        rot = self._late(unwrap_quats(torch.tensor(seen.rot)).numpy(), seen.fps)
        return late._replace(rot=rot / np.linalg.norm(rot, axis=-1, keepdims=True))

    def _late(self, values: np.ndarray, fps: float) -> np.ndarray:
        at = np.maximum(np.arange(len(values)) - self.seconds * self.strength * fps, 0.0)
        low = np.floor(at + 1e-9).astype(int)
        high = np.minimum(low + 1, len(values) - 1)
        t = np.clip(at - low, 0.0, 1.0).reshape(-1, *(1,) * (values.ndim - 1))
        # Where it comes on a whole frame the frame behind it must not matter, since it may be missing.
        return np.where(t > 1e-9, values[low] * (1 - t) + values[high] * t, values[low])


def last_seen(lost: np.ndarray) -> np.ndarray:
    """`(T, K)`, the frame that stands in for each: the last one not lost, at the start the first one.

    Where all frames of a column are lost it is frame 0.
    """
    frames = np.arange(len(lost))[:, None]
    at = np.maximum.accumulate(np.where(lost, -1, frames), axis=0)
    first = np.where(lost.all(0), 0, (~lost).argmax(0))
    return np.where(at < 0, first, at)


def _unit(axis: Vector) -> np.ndarray:
    """The unit vector along `axis`; one without length is refused."""
    length = float(np.linalg.norm(axis))
    if not length > 1e-9:
        raise PoiseError(f"the axis must have a length, got {axis}")
    return np.array(axis) / length


def _turned(rot: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Rotations `(..., 4)` turned in their own frames by rotation vectors `(..., 3)` rad."""
    return quat_mul(torch.tensor(rot), rotvec_to_quat(torch.tensor(turns))).numpy()
