"""Channels of a motion without their noise: each is smoothed as much as it trembles, no more.

A channel is taken as y = x + n + e: motion x, a tremble n at a frequency, white noise e. Their sizes are
measured (`spectrum`); n goes first,

    min over x, n   sum |y - x - n|^2 / s^2 + lambda |x'''|^2
                        + |n_t+1 - 2 r cos(w) n_t + r^2 n_t-1|^2 / q,

then x is the mean of smoothing splines of many stiffnesses lambda, each weighted in every frame by how
near to the truth Stein's unbiased estimate says it is there:

    risk = |y - S y|^2 / s^2 + 2 tr(S) / T,

the mean over a joint's channels, around the frame and over the clip.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise

import numpy as np

from poise.motion.spectrum import Spectrum

#: Frequencies (Hz) at which the gain of the splines is one half.
CUTOFFS = tuple(np.geomspace(0.35, 14.0, 20))
#: Deviation (s) of the surroundings in which a stiffness is judged, the share of the whole clip in that
#: judgement, and the deviation (s) over which its weight changes.
AROUND_S, WHOLE, CHANGE_S = 0.3, 0.7, 0.1
#: Width (Hz) of a tremble: the rate at which its size and phase wander.
WANDER_HZ = 0.15
#: Below this frequency (Hz) people step: there a tremble has in no group more than so many times the
#: variance that it has in the quietest (this quantile of all).
STEPS_HZ, UNEVEN, QUIET = 3.5, 1.5, 0.4
#: Length (s) of the pieces that are told and smoothed by themselves, and how long they overlap.
PIECE_S, OVERLAP_S = 30.0, 2.0
#: How fast (Hz) a curve through what is missing may turn.
FILL_HZ = 6.0
_THIRD = np.array([-1.0, 3.0, -3.0, 1.0])


def filled(y: np.ndarray, known: np.ndarray, fps: float) -> np.ndarray:
    """`y (T, C)` with the frames that are not `known (T)` on the smoothest curve through the rest."""
    band = np.zeros((4, len(y)))
    band[0] = known + 1e-9
    from scipy.linalg import solveh_banded

    _add(band, _THIRD, float((2 * np.sin(np.pi * FILL_HZ / fps)) ** -6), len(y), 1, 0)
    curve = solveh_banded(band, y * known[:, None], lower=True)
    # The curve passes by what it is told; what it leaves there goes on in between.
    at, frames = np.flatnonzero(known), np.arange(len(y))
    for c in range(y.shape[1]) if len(at) else ():
        curve[:, c] += np.interp(frames, at, y[at, c] - curve[at, c])
    return np.where(known[:, None], y, curve)


def pieces(frames: int, fps: float) -> list[slice]:
    """Frames of the pieces, each of which overlaps the next."""
    size, overlap = round(PIECE_S * fps), round(OVERLAP_S * fps)
    count = max(1, math.ceil((frames - overlap) / (size - overlap)))
    edges = np.linspace(0, frames - overlap, count + 1).round().astype(int).tolist()
    return [slice(a, min(b + overlap, frames)) for a, b in pairwise(edges)]


def faded(here: slice, frames: int, fps: float) -> np.ndarray:
    """How much a piece counts in each of its frames `(T)`, where it meets those beside it."""
    overlap = round(OVERLAP_S * fps)
    share = np.ones(here.stop - here.start)
    ramp = (np.arange(overlap) + 1) / (overlap + 1)
    if here.start > 0:
        share[:overlap] = ramp[: len(share)]
    # The next piece takes over from its first frame on, be it smoothed or not.
    if here.stop < frames:
        share[-overlap:] *= ramp[::-1]
    return share


def tremble_of(
    y: np.ndarray, groups: np.ndarray, found: Spectrum, hz: float, most: float = math.inf
) -> tuple[np.ndarray, np.ndarray]:
    """The tremble `(T, C)` at `hz`, and `(G)` how far it stands out of what is beside it. most: the
    largest variance that it can have in a group."""
    out = np.zeros_like(y)
    size, beside = found.tone(hz)
    floor, clear = found.floor(), size / np.maximum(beside, 1e-300)
    if hz < STEPS_HZ:
        # A group with more than that steps by itself, and as narrowly as a tremble: the power of
        # either at hz is its variance times fps / (pi WANDER_HZ).
        usual = UNEVEN * float(np.quantile(size, QUIET, method="lower"))
        own = np.maximum(size - usual, 0.0) * found.fps / (np.pi * WANDER_HZ)
        beside, most = beside + own, min(most, usual)
    size = np.minimum(size, most)
    for g in np.unique(groups):
        if size[g] <= 0.0:
            continue
        mine = np.flatnonzero(groups == g)
        white = max(floor[g], 0.02 * beside[g], 1e-4 * size[g])
        motion = max(beside[g] - white, 0.1 * white) / white
        # The spline's power at hz is that of the motion there: 1 / (lambda |2 sin(w / 2)|^6).
        stiff = 1.0 / (motion * (2 * np.sin(np.pi * hz / found.fps)) ** 6)
        unit = np.sqrt(white / len(mine))
        out[:, mine] = unit * _split(y[:, mine] / unit, found.fps, hz, stiff, float(size[g] / white))
    return out, clear


def _split(y: np.ndarray, fps: float, hz: float, stiff: float, size: float) -> np.ndarray:
    """n of the module's text, for white noise of size 1 and a tremble of variance `size`."""
    frames = len(y)
    wander = np.exp(-np.pi * WANDER_HZ / fps)
    step = np.array([wander**2, -2 * wander * np.cos(2 * np.pi * hz / fps), 1.0])
    # The variance of the process for steps of variance 1.
    own = (1 + step[0]) / ((1 - step[0]) * ((1 + step[0]) ** 2 - step[1] ** 2))
    band = np.zeros((8, 2 * frames))
    # Unknowns x_0, n_0, x_1, n_1, ...
    band[0] += 1.0
    band[1, 0::2] += 1.0
    _add(band, _THIRD, stiff, frames, 2, 0)
    _add(band, step, own / size, frames, 2, 1)
    # The first two of n are as large as all others: else a tone of any size would cost nothing.
    like = -step[1] / (1 + step[0])
    first = 1.0 / (size * (1.0 - like**2))
    band[0, [1, 3]] += first
    band[2, 1] -= like * first
    from scipy.linalg import solveh_banded

    return solveh_banded(band, np.repeat(y, 2, axis=0), lower=True)[1::2]


def _add(band: np.ndarray, row: np.ndarray, weight: float, frames: int, stride: int, first: int) -> None:
    """Adds `weight |row * z|^2` at every frame to normal equations in lower banded form."""
    count = frames - len(row) + 1
    for i in range(len(row)):
        for j in range(i + 1):
            at = stride * (np.arange(max(count, 0)) + j) + first
            band[stride * (i - j), at] += weight * row[i] * row[j]


@lru_cache(maxsize=64)
def spline(frames: int, stiff: float) -> np.ndarray:
    """The Cholesky factor, lower banded, of a smoothing spline of stiffness lambda."""
    from scipy.linalg import cholesky_banded

    band = np.zeros((4, frames))
    band[0] = 1.0
    _add(band, _THIRD, stiff, frames, 1, 0)
    return cholesky_banded(band, lower=True)


def smoothed(y: np.ndarray, fps: float, groups: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """The channels without white noise of variance `floor (G)`, the sum over a group's channels."""
    from scipy.linalg import cho_solve_banded
    from scipy.ndimage import gaussian_filter1d

    curves, traces = [y], [1.0]
    turn = np.linspace(0.0, np.pi, 400)
    for cutoff in (c for c in CUTOFFS if c < 0.45 * fps):
        stiff = float((2 * np.sin(np.pi * cutoff / fps)) ** -6)
        curves.append(cho_solve_banded((spline(len(y), stiff), True), y))
        traces.append(float(np.mean(1.0 / (1.0 + stiff * (2 * np.sin(turn / 2)) ** 6))))
    trace, out = np.array(traces), np.empty_like(y)
    for g in np.unique(groups):
        mine = np.flatnonzero(groups == g)
        white = floor[g] / len(mine)
        if white <= 0.0:
            out[:, mine] = y[:, mine]
            continue
        # One stack a group: that of all would be many times the clip.
        stack = np.stack([c[:, mine] for c in curves])
        off = ((stack - stack[:1]) ** 2).mean(-1) / white
        risk = (1 - WHOLE) * gaussian_filter1d(off, AROUND_S * fps, axis=1, mode="reflect")
        risk += WHOLE * off.mean(1, keepdims=True) + 2 * trace[:, None]
        samples = 2.5 * AROUND_S * fps * len(mine)
        share = np.exp(-samples * (risk - risk.min(0)))
        share = gaussian_filter1d(share / share.sum(0), CHANGE_S * fps, axis=1, mode="nearest")
        out[:, mine] = (share[..., None] * stack).sum(0)
    return out
