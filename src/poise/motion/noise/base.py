"""What a kind of noise is, what it acts on, and the random paths that the kinds share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from poise.errors import PoiseError

_LEG_WORDS = ("hip", "leg", "thigh", "femur", "knee", "tibia", "shin", "ankle", "foot", "heel", "toe")
_SIDES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"))


class Seen(NamedTuple):
    """What noise acts on: named points, or a pose.

    pos: `(T, K, 3)` m, NaN where a point is missing; of a pose the root alone, `(T, 1, 3)`.
    rot: `(T, J, 4)` wxyz, a pose's local rotations; None for points.
    fps: frames per second. pairs: left and right, see `side_pairs`.
    """

    pos: np.ndarray
    rot: np.ndarray | None
    fps: float
    pairs: tuple[tuple[int, int, str], ...]


@dataclass(frozen=True, kw_only=True)
class Noise:
    """One kind of error of an estimator.

    strength: 1 is as the docstring of the kind says, 0 changes nothing. seed: the same seed makes the
    same noise; another strength makes the same one at another size, so that curves over it are smooth.
    """

    strength: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            numbers = value if isinstance(value, tuple) else (value,)
            bad = [v for v in numbers if isinstance(v, int | float) and not math.isfinite(v)]
            if bad or (
                name not in ("axis", "camera", "bias") and any(v < 0 for v in numbers if v is not None)
            ):
                raise PoiseError(f"{name} of {type(self).__name__} must not be negative, got {value}")

    def on(self, seen: Seen, rng: np.random.Generator) -> Seen:
        """What is seen with this noise."""
        raise PoiseError(f"{type(self).__name__} does not say what it does")


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
