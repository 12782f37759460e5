"""Noise on clips, keypoints and arrays of positions, one after another, and ladders of its strength."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.keypoints import Keypoints
from poise.motion.noise.base import Noise, Seen, side_pairs
from poise.motion.noise.kinds import (
    Drift,
    Dropouts,
    FrameLoss,
    Jitter,
    Latency,
    Outliers,
    SwapSides,
    WrongDepth,
    last_seen,
)

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
    seen = Seen(clip.root_pos[:, None], clip.rot, clip.fps, side_pairs(clip.skeleton.names))
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
        raise PoiseError(f"positions must be (T, {len(names)}, 3), got {positions.shape}")
    seen = Seen(np.asarray(positions, dtype=float), None, fps, side_pairs(tuple(names)))
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
        raise PoiseError("a ladder needs some noise and strengths from 0 on")
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
