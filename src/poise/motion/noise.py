"""Errors of pose estimators, made on purpose: kinds, their composition, ladders of strength."""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.keypoints import Keypoints
from poise.motion.rotations import quat_mul, rotvec_to_quat, unwrap_quats
from poise.settings import Checked, NotNegative, Range

_LEG_WORDS = ("hip", "leg", "thigh", "femur", "knee", "tibia", "shin", "ankle", "foot", "heel", "toe")
_SIDES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"))


class NoiseInput(NamedTuple):
    """What noise acts on: named points, or a pose.

    pos: `(T, K, 3)` m, NaN where a point is missing; of a pose the root alone, `(T, 1, 3)`.
    rot: `(T, J, 4)` wxyz, a pose's local rotations; None for points. A point that is lost becomes NaN; a
    pose, which must be whole, holds what was last seen.
    fps: frames per second. pairs: left and right, see `side_pairs`.
    """

    pos: np.ndarray
    rot: np.ndarray | None
    fps: float
    pairs: tuple[tuple[int, int, str], ...]


@dataclass(frozen=True, kw_only=True)
class Noise(Checked):
    """One kind of error of an estimator.

    strength: 1 is as the docstring of the kind says, 0 changes nothing. seed: the same seed makes the
    same noise; another strength makes the same one at another size, so that curves over it are smooth.
    """

    strength: NotNegative = 1.0
    seed: int = 0

    def on(self, seen: NoiseInput, rng: np.random.Generator) -> NoiseInput:
        """What is seen with this noise."""
        raise PoiseError(f"{type(self).__name__} does not say what it does", code="not-implemented")


def side_pairs(names: tuple[str, ...]) -> tuple[tuple[int, int, str], ...]:
    """(left, right, "arm" or "leg") of all names that come in two sides.

    "LeftFoot" and "RightFoot", "l_knee" and "r_knee", "lfemur" and "rfemur", "LWrist" and "RWrist".
    """
    out = []
    for i, name in enumerate(names):
        other = _mirrored(name, names)
        if other is not None:
            leg = any(w in name.lower() for w in _LEG_WORDS)
            out.append((i, names.index(other), "leg" if leg else "arm"))
    return tuple(out)


def _mirrored(name: str, names: tuple[str, ...]) -> str | None:
    """The right side's name of a left one, None for all others."""
    tries = [name.replace(a, b) for a, b in _SIDES if a in name]
    tries += [b + name[1:] for a, b in (("l", "r"), ("L", "R")) if name.startswith(a)]
    tries += [
        name[: -len(a)] + b
        for a, b in (("_l", "_r"), (".l", ".r"), ("_L", "_R"), (".L", ".R"))
        if name.endswith(a)
    ]
    return next((t for t in tries if t != name and t in names), None)


def smooth_path(
    rng: np.random.Generator, frames: int, shape: tuple[int, ...], fps: float, tau_s: float
) -> np.ndarray:
    """`(T, *shape)`, unit Gaussian noise of autocorrelation exp(-(t / tau)^2 / 2); white for 0.

    White noise through a Gaussian of deviation tau / sqrt(2), scaled back to unit variance.
    """
    sigma = tau_s * fps / math.sqrt(2.0)
    reach = math.ceil(4.0 * sigma)
    # The draw does not depend on the reach, so that one seed is one path at every correlation time.
    white = rng.standard_normal((frames, *shape))
    if reach == 0:
        return white
    ends = rng.standard_normal((2 * reach, *shape))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= np.sqrt(np.sum(kernel**2))
    padded = np.concatenate((ends[:reach], white, ends[reach:]))
    out = np.zeros_like(white)
    for k, weight in enumerate(kernel):
        out += weight * padded[k : k + frames]
    return out


def wandering_path(
    rng: np.random.Generator, frames: int, shape: tuple[int, ...], fps: float, tau_s: float
) -> np.ndarray:
    """`(T, *shape)`, unit Ornstein-Uhlenbeck noise: autocorrelation exp(-t / tau), no memory for 0.

    x_t+1 = r x_t + sqrt(1 - r^2) n with r = exp(-1 / (fps tau)), begun in its stationary law.
    """
    rho = math.exp(-1.0 / (fps * tau_s)) if tau_s > 0 else 0.0
    white = rng.standard_normal((frames, *shape))
    out = white.copy()
    for t in range(1, frames):
        out[t] = rho * out[t - 1] + math.sqrt(1.0 - rho**2) * white[t]
    return out


def spell_mask(
    rng: np.random.Generator, frames: int, count: int, fps: float, share: float, mean_s: float
) -> np.ndarray:
    """`(T, count)` bool, spells of mean length `mean_s` that cover `share` of the time.

    Each column is a two-state Markov chain: a spell ends with q = 1 / (mean_s fps), at most 1, and one
    begins with p = q share / (1 - share). The same draws at a larger share cover more.
    """
    if share >= 1:
        return np.ones((frames, count), dtype=bool)
    end = min(1.0, 1.0 / max(mean_s * fps, 1e-9))
    begin = end * share / (1.0 - share)
    if begin > 1.0:
        # Spells so dense that no gap of a frame is left between them on average: they must be longer.
        end, begin = (1.0 - share) / share, 1.0
    draw = rng.random((frames, count))
    out = np.zeros((frames, count), dtype=bool)
    out[0] = draw[0] < share
    for t in range(1, frames):
        out[t] = np.where(out[t - 1], draw[t] < 1.0 - end, draw[t] < begin)
    return out


Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Jitter(Noise):
    """Every point trembles by `sigma_m` m per coordinate, each on its own, correlated over `tau_s` s.

    axis, axis_ratio: a direction along which it is larger, such as a camera's. On a pose the root
    trembles by `sigma_m` and every joint turns by `sigma_rad` rad per axis (20 mm at the end of a
    forearm and hand).
    """

    sigma_m: NotNegative = 0.02
    sigma_rad: NotNegative = 0.05
    tau_s: NotNegative = 0.06
    axis: Vector = (1.0, 0.0, 0.0)
    axis_ratio: NotNegative = 1.0

    def on(self, seen: NoiseInput, rng: np.random.Generator) -> NoiseInput:
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

    share: NotNegative = 0.16
    size_m: NotNegative = 0.035
    size_rad: NotNegative = 0.1

    def on(self, seen: NoiseInput, rng: np.random.Generator) -> NoiseInput:
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

    sigma_m: Annotated[Vector, Range(0)] = (0.045, 0.045, 0.045)
    tau_s: NotNegative = 0.8

    def on(self, seen: NoiseInput, rng: np.random.Generator) -> NoiseInput:
        path = wandering_path(rng, len(seen.pos), (3,), seen.fps, self.tau_s)
        return seen._replace(pos=seen.pos + (self.strength * np.array(self.sigma_m) * path)[:, None])


@dataclass(frozen=True, kw_only=True)
class WrongDepth(Noise):
    """Distances along the camera's axis are wrong by a factor 1 + e: p' = p + e ((p - c) . a) a.

    e wanders by `sigma` with a memory of `tau_s` s, about `bias`. camera: its place c in m, by default
    4 m in front of where the body begins, looking along `axis` a. On a pose it moves the root.
    """

    sigma: NotNegative = 0.03
    bias: float = 0.0
    tau_s: NotNegative = 0.5
    axis: Vector = (1.0, 0.0, 0.0)
    camera: Vector | None = None

    def on(self, seen: NoiseInput, rng: np.random.Generator) -> NoiseInput:
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

    share: NotNegative = 0.04
    mean_s: NotNegative = 0.19

    def on(self, seen: NoiseInput, rng: np.random.Generator) -> NoiseInput:
        if seen.rot is None:
            lost = self._lost(rng, seen, seen.pos.shape[1])
            return seen._replace(pos=np.where(lost[..., None], np.nan, seen.pos))
        at = last_seen(self._lost(rng, seen, seen.rot.shape[1]))
        return seen._replace(rot=np.take_along_axis(seen.rot, at[..., None], 0))

    def _lost(self, rng: np.random.Generator, seen: NoiseInput, count: int) -> np.ndarray:
        """`(T, count)`, what is missing when."""
        share = min(self.share * self.strength, 1.0)
        return spell_mask(rng, len(seen.pos), count, seen.fps, share, self.mean_s)


@dataclass(frozen=True, kw_only=True)
class FrameLoss(Dropouts):
    """Whole frames are missing for `share` of the time, in spells of `mean_s` s on average."""

    share: NotNegative = 0.03
    mean_s: NotNegative = 0.1

    def on(self, seen: NoiseInput, rng: np.random.Generator) -> NoiseInput:
        lost = self._lost(rng, seen, 1)
        if seen.rot is None:
            return seen._replace(pos=np.where(lost[..., None], np.nan, seen.pos))
        at = last_seen(lost)[:, 0]
        return seen._replace(pos=seen.pos[at], rot=seen.rot[at])


@dataclass(frozen=True, kw_only=True)
class SwapSides(Noise):
    """Left is taken for right for `share` of the time, in spells of `mean_s` s, arms and legs apart."""

    share: NotNegative = 0.02
    mean_s: NotNegative = 0.15

    def on(self, seen: NoiseInput, rng: np.random.Generator) -> NoiseInput:
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

    seconds: NotNegative = 0.1

    def on(self, seen: NoiseInput, rng: np.random.Generator) -> NoiseInput:
        del rng
        late = seen._replace(pos=self._late(seen.pos, seen.fps))
        if seen.rot is None:
            return late
        rot = self._late(unwrap_quats(seen.rot), seen.fps)
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
        raise PoiseError(f"the axis must have a length, got {axis}", code="no-direction")
    return np.array(axis) / length


def _turned(rot: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Rotations `(..., 4)` turned in their own frames by rotation vectors `(..., 3)` rad."""
    return quat_mul(rot, rotvec_to_quat(turns))


#: Several cameras, triangulated (Pose2Sim, as measured): one axis is twice as bad, nothing is smoothed.
TRIANGULATED: tuple[Noise, ...] = (
    Jitter(sigma_m=0.003, sigma_rad=0.01, tau_s=0.0, axis_ratio=2.0),
    Outliers(),
)
#: One camera (Rokoko Vision where measured, see the kinds): everything that can go wrong with it.
VIDEO: tuple[Noise, ...] = (
    SwapSides(),
    Jitter(),
    WrongDepth(),
    Drift(),
    Dropouts(),
    FrameLoss(),
    Latency(),
)


@dataclass(frozen=True)
class Level:
    """One rung of a ladder: `noise` at `strength`, 0 for none."""

    name: str
    strength: float
    noise: tuple[Noise, ...]


def perturb_clip(clip: Clip, noise: Noise | Sequence[Noise], seed: int = 0) -> Clip:
    """The clip as an estimator of rotations would have seen it; the noise acts in the order given.

    The numbers depend on `seed`, on each noise's own seed and place, and on the clip's name.
    """
    seen = NoiseInput(clip.root_pos[:, None], clip.rot, clip.fps, side_pairs(clip.skeleton.names))
    for one, rng in _each(noise, seed, clip.name):
        seen = one.on(seen, rng)
    return clip.replaced(root_pos=seen.pos[:, 0], rot=seen.rot)


def perturb_points(points: Keypoints, noise: Noise | Sequence[Noise], seed: int = 0) -> Keypoints:
    """The keypoints with noise; what is lost is NaN."""
    pos = perturb_positions(points.positions, points.fps, points.names, noise, seed, points.name)
    return points.replaced(positions=pos)


def perturb_positions(
    positions: np.ndarray,
    fps: float,
    names: Sequence[str],
    noise: Noise | Sequence[Noise],
    seed: int = 0,
    name: str = "",
) -> np.ndarray:
    """Positions `(T, K, 3)` m of points called `names`, with noise; what is lost is NaN."""
    if positions.ndim != 3 or positions.shape[1:] != (len(names), 3):
        raise PoiseError(
            f"positions must be (T, {len(names)}, 3), got {positions.shape}", code="wrong-shape"
        )
    seen = NoiseInput(np.asarray(positions, dtype=float), None, fps, side_pairs(tuple(names)))
    for one, rng in _each(noise, seed, name):
        seen = one.on(seen, rng)
    return seen.pos


def hold_missing(positions: np.ndarray) -> np.ndarray:
    """Positions `(T, K, 3)` with every gap held at what was last seen, as a live receiver does."""
    lost = np.asarray(np.isnan(positions).any(-1))
    return np.take_along_axis(positions, last_seen(lost)[..., None], 0)


def scaled(noise: Sequence[Noise], factor: float) -> tuple[Noise, ...]:
    """The same noise at `factor` times its strength."""
    return tuple(replace(one, strength=one.strength * factor) for one in noise)


def robustness_levels(
    noise: Sequence[Noise] = VIDEO,
    strengths: Sequence[float] = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0),
    each: bool = False,
) -> tuple[Level, ...]:
    """A ladder for a robustness curve: all of `noise` at every strength, weakest first.

    each: adds a ladder for every kind alone, without a second rung for no noise at all.
    """
    if not noise or any(s < 0 for s in strengths):
        raise PoiseError("a ladder needs some noise and strengths from 0 on", code="out-of-range")
    rungs = sorted(strengths)
    out = [Level(f"all x{s:g}" if s else "clean", s, scaled(noise, s)) for s in rungs]
    if each:
        for one in noise:
            kind = type(one).__name__
            out += [Level(f"{kind} x{s:g}", s, scaled((one,), s)) for s in rungs if s]
    return tuple(out)


def _each(
    noise: Noise | Sequence[Noise], seed: int, name: str
) -> list[tuple[Noise, np.random.Generator]]:
    """Every noise that does something, each with random numbers of its own."""
    chain = [noise] if isinstance(noise, Noise) else list(noise)
    word = zlib.crc32(name.encode())
    return [
        (one, np.random.default_rng((seed, one.seed, k, word)))
        for k, one in enumerate(chain)
        if one.strength > 0
    ]
