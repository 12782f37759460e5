"""Noise told from motion by its spectrum, channels without it, runs in which something holds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from poise.errors import PoiseError
from poise.motion.vectors import Array

#: Edges of the bands, as shares of half the frame rate, in which a floor is looked for; a band belongs
#: to it while all groups together have less than `FLAT` times the power of the highest three.
BANDS, FLAT = np.linspace(0.4, 1.0, 9), 1.25
#: From a frequency (Hz) on a tremble stands out of the octave below by this factor, and by `ABOVE` times
#: this out of the octave above, in what the quietest of all channels but these shares have at most.
#: People's joints differ by orders of magnitude, and the quiet ones have no step of their own; a tremble
#: is in all. What is slower has such peaks of its own.
TREMBLES = ((1.6, 7.0), (2.5, 4.0), (3.5, 3.0))
ABOVE, QUIETEST = 4.0, (0.1, 0.2, 0.3, 0.5)
#: Channels of less power than this share of the strongest one's stand still.
STILL = 1e-9
#: A tremble is told apart from this many widths of a tone on.
RESOLVED = 1.9
#: The highest tremble (Hz) that is looked for by itself; what is faster counts as white noise.
HIGHEST_HZ = 15.0
#: White noise (mm, rms over joints) from which a motion trembles: clean ones have up to 4, where it is
#: fast, at 30 frames/s. Less than this share of the way from frame to frame (rms) is none either: flips
#: and sprints have it. Where the highest bands begin below this frequency (Hz) they hold motion.
WHITE_MM, WHITE_SHARE, WHITE_HZ = 5.0, 0.08, 6.0
#: White noise (mm) that leaves nothing of a motion.
NOTHING_MM = 300.0
#: Frames that a clip must have for its noise to be told.
SHORTEST = 12
#: So many trembles are looked for, one after another.
LINES = 3


@dataclass(frozen=True)
class Spectrum:
    """Power of channels, as the variance that white noise of the same power had.

    hz: `(F)`. channels: `(F, C)`. power: `(F, G)`, sum over the channels of a group. width: what a pure
    tone is spread over, Hz.
    """

    hz: np.ndarray
    channels: np.ndarray
    power: np.ndarray
    width: float
    fps: float

    @classmethod
    def of(cls, y: np.ndarray, fps: float, groups: np.ndarray) -> Spectrum:
        """The Hann periodogram of `y (T, C)`, its straight trend taken off; `groups (C)` from 0 on."""
        frames = len(y)
        t = np.linspace(-1.0, 1.0, frames)
        basis = np.stack((np.ones(frames), t), 1)
        y = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
        window = np.hanning(frames + 2)[1:-1]
        size = 2 ** math.ceil(math.log2(4 * frames))
        raw = squared(np.fft.rfft(y * window[:, None], size, axis=0)) / (window**2).sum()
        power = raw @ (groups[:, None] == np.arange(groups.max() + 1)).astype(float)
        return cls(np.fft.rfftfreq(size, 1 / fps), raw, power, 2.0 * fps / frames, fps)

    def near(self, hz: float) -> np.ndarray:
        """Where a tone of `hz` has its peak."""
        return np.abs(self.hz - hz) <= max(0.06, 0.25 * self.width)

    def floor(self) -> np.ndarray:
        """`(G)` variance of the white noise in each group: the mean over the bands that are flat.

        White noise ends the spectrum's fall at a floor that all joints reach.
        """
        edges = BANDS * self.fps / 2
        bands = np.stack(
            [self.power[(self.hz >= a) & (self.hz < b + 1e-9)].mean(0) for a, b in pairwise(edges)]
        )
        top = bands[-3:].mean(0)
        alive = top > 1e-12 * top.max()
        if not alive.any():
            return np.zeros_like(top)
        fall = np.exp(np.log(np.maximum(bands[:, alive], 1e-300) / top[alive]).mean(1))
        first = len(bands) - 3
        if fall[first - 1] >= FLAT and fall[first] >= FLAT * fall[-1]:
            # The spectrum falls to its end: at most the last band is noise.
            return bands[-1] * min(1.0, float(fall[-1]))
        while first > 0 and fall[first - 1] < FLAT:
            first -= 1
        return bands[first:].mean(0)

    def tremble(self) -> float | None:
        """The frequency (Hz) of the clearest tremble, None without any.

        People's joints are slow: above some 2 Hz the spectrum of every joint falls with frequency, and a
        gait has more power an octave below than in its harmonics. A tremble stands out of the octave
        below it and the octave above it, in most joints at once.
        """
        total = self.channels.sum(0)
        alive = self.channels[:, total > STILL * total.max()]
        # Bins of a quarter of a tone's width, each with its largest power.
        size = max(1, round(0.25 * self.width / self.hz[1]))
        top = min(int(np.searchsorted(self.hz, 2.3 * HIGHEST_HZ)), len(self.hz))
        count = top // size
        if count < 8 or not alive.shape[1]:
            return None
        power = alive[: count * size].reshape(count, size, -1).max(1)
        hz = self.hz[: count * size].reshape(count, size).mean(1)
        at = np.flatnonzero((hz >= max(TREMBLES[0][0], RESOLVED * self.width)) & (hz <= HIGHEST_HZ))
        at = at[hz[at] < 0.42 * self.fps]
        gap = np.maximum(self.width, 0.12 * hz[at])
        spans = [
            (np.searchsorted(hz, low), np.searchsorted(hz, high, "right"))
            for low, high in ((hz[at] / 2.2, hz[at] - gap), (hz[at] + gap, 2.3 * hz[at]))
        ]
        known = np.logical_and.reduce([first < stop for first, stop in spans])
        at, spans = at[known], [(first[known], stop[known]) for first, stop in spans]
        if not len(at):
            return None
        peak = np.maximum(power, np.maximum(np.roll(power, 1, axis=0), np.roll(power, -1, axis=0)))
        quiet = np.maximum(np.quantile(power, QUIETEST, axis=1).T, 1e-30)
        over, under = (
            np.quantile(peak[at], QUIETEST, axis=1).T / _largest(quiet, *span) for span in spans
        )
        starts, limits = np.array(TREMBLES).T
        limit = limits[np.searchsorted(starts, hz[at] + 1e-9) - 1]
        clear = np.minimum(over, under / ABOVE).max(1) / limit
        if clear.max() < 1.0:
            return None
        power, found = alive, float(hz[at[clear.argmax()]])
        # The peak itself: all channels have a say by their share.
        near = np.flatnonzero(np.abs(self.hz - found) <= max(0.1, 0.5 * self.width))
        shape = (power[near] / power[near].max(0)).sum(1)
        k = min(max(int(shape.argmax()), 1), len(near) - 2) if len(near) > 2 else 0
        if not k:
            return found
        left, here, right = np.log(shape[k - 1 : k + 2])
        bend = left - 2 * here + right
        shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
        return float(self.hz[near[k]] + min(max(shift, -1.0), 1.0) * (self.hz[1] - self.hz[0]))

    def tone(self, hz: float) -> tuple[np.ndarray, np.ndarray]:
        """`(G)` variance of a tone at `hz`, and `(G)` power of what lies beside it."""
        away = np.abs(self.hz - hz)
        beside = (away > 1.2 * self.width) & (away < max(2.4 * self.width, 0.8))
        rest = np.exp(np.log(np.maximum(self.power[beside], 1e-300)).mean(0)) if beside.any() else 0.0
        peak = self.power[self.near(hz)].max(0)
        # As `peak_of`, the other way round.
        return np.maximum(peak - rest, 0.0) / self.peak_of(1.0), rest + np.zeros_like(peak)

    def peak_of(self, variance: np.ndarray | float) -> np.ndarray:
        """The power at the peak of tones of a variance: a sin(2 pi f t) under a Hann window of T frames
        has a^2 T / 6."""
        return np.asarray(variance) * (2.0 / self.width) * self.fps / 3.0


def squared(waves: np.ndarray) -> np.ndarray:
    """|z|^2 of complex numbers z."""
    return np.real(waves) ** 2 + np.imag(waves) ** 2


def _largest(values: np.ndarray, first: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """`(N, C)` the largest of `values (B, C)` from `first (N)` up to but without `stop (N)`."""
    table, reach = [values], 1
    while 2 * reach <= len(values):
        last = table[-1]
        table.append(np.maximum(last[: len(last) - reach], last[reach:]))
        reach *= 2
    level = np.floor(np.log2(stop - first)).astype(int)
    out = np.empty((len(first), values.shape[1]))
    for k in np.unique(level):
        here = level == k
        out[here] = np.maximum(table[k][first[here]], table[k][stop[here] - 2**k])
    return out


def only_noise(source: str, here: slice, size: str) -> PoiseError:
    """The error of frames that jump about by that `size` each, so that nothing is left to be told."""
    return PoiseError(
        f"frames {here.start} to {here.stop - 1} jump about by {size} each: there is no motion to be "
        "told",
        source,
        "Cut them off; --raw takes the file as it is",
        code="only-noise",
    )


def white_mm(positions: np.ndarray, fps: float) -> float:
    """White noise (mm, rms over joints) of `positions (T, J, 3)` m: the floor of the spectrum or that of
    the median frame, whichever is less, since a burst of motion is no noise."""
    frames, joints = positions.shape[:2]
    if frames < SHORTEST or 0.35 * fps < WHITE_HZ:
        return 0.0
    groups = np.repeat(np.arange(joints), 3)
    floor = Spectrum.of(positions.reshape(frames, -1), fps, groups).floor().mean()
    # Fourth differences of white noise of deviation s have sqrt(70) s; the median length of a normal
    # 3-vector is 1.538 s.
    rough = np.median(np.linalg.norm(np.diff(positions, n=4, axis=0), axis=-1), axis=0)
    usual = 3.0 * ((rough / (math.sqrt(70.0) * 1.538)) ** 2).mean()
    white = math.sqrt(min(floor, usual))
    way = math.sqrt((np.diff(positions, axis=0) ** 2).sum(-1).mean())
    return 1e3 * white if white > WHITE_SHARE * way else 0.0


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


#: Frames times tracks that are filled at once; more would take gigabytes.
_AT_ONCE = 2**18


def filled(y: np.ndarray, known: np.ndarray, fps: float) -> np.ndarray:
    """`y (T, C)` with the frames that are not `known (T)` on the smoothest curve through the rest; or
    several of them, `(K, T, C)` and `(K, T)`."""
    if y.ndim == 2:
        return filled(y[None], known[None], fps)[0]
    if known.all():
        return y
    tracks, frames = known.shape
    if tracks > (most := max(1, _AT_ONCE // frames)):
        each = [slice(k, k + most) for k in range(0, tracks, most)]
        return np.concatenate([filled(y[k], known[k], fps) for k in each])
    band = np.zeros((tracks, 4, frames))
    band[:, 0] = known + 1e-9
    _add(band, _THIRD, float((2 * np.sin(np.pi * FILL_HZ / fps)) ** -6), frames, 1, 0)
    curve = solve_banded(band, y * known[..., None])
    # The curve passes by what it is told; what it leaves there goes on in between.
    for k, seen in enumerate(known):
        at = np.flatnonzero(seen)
        for c in range(y.shape[-1]) if len(at) else ():
            curve[k, :, c] += np.interp(np.arange(frames), at, y[k, at, c] - curve[k, at, c])
    return np.where(known[..., None], y, curve)


#: Rows of the blocks in which a banded matrix is solved.
_BLOCK = 16


def solve_banded(band: np.ndarray, y: np.ndarray) -> np.ndarray:
    """x `(..., T, C)` with A x = y, for A symmetric, positive definite and in lower banded form
    `(..., W, T)`: row k of the band holds A[t + k, t].

    As a matrix of blocks A has three diagonals, and is eliminated from its first block to its last.
    SciPy has the same for one matrix, and takes longer to load than a clip takes to be read.
    """
    lead, (wide, frames), size = band.shape[:-2], band.shape[-2:], max(_BLOCK, band.shape[-2])
    count = -(-frames // size)
    rows, right = np.zeros((*lead, wide, count * size)), np.zeros((*lead, count * size, y.shape[-1]))
    rows[..., :frames], right[..., :frames, :] = band, y
    # The last block is filled up with equations x = 0.
    rows[..., 0, frames:] = 1.0
    rows, right = rows.reshape(*lead, wide, count, size), right.reshape(*lead, count, size, -1)
    here, below = np.zeros((2, *lead, count, size, size))
    for k in range(wide):
        j = np.arange(size - k)
        here[..., j + k, j] = here[..., j, j + k] = rows[..., k, :, : size - k]
        j = np.arange(size - k, size)
        below[..., j + k - size, j] = rows[..., k, :, size - k :]
    known = right[..., 0, :, :]
    ahead, out = [], []
    for k in range(count):
        above = np.swapaxes(below[..., k, :, :], -1, -2)
        solved = np.linalg.solve(here[..., k, :, :], np.concatenate((above, known), -1))
        ahead.append(solved[..., :size])
        out.append(solved[..., size:])
        if k + 1 < count:
            here[..., k + 1, :, :] -= below[..., k, :, :] @ ahead[k]
            known = right[..., k + 1, :, :] - below[..., k, :, :] @ out[k]
    for k in reversed(range(count - 1)):
        out[k] -= ahead[k] @ out[k + 1]
    return np.concatenate(out, -2)[..., :frames, :]


def eased(y: np.ndarray, weight: np.ndarray, fps: float, hz: float) -> np.ndarray:
    """`y (T, C)` without what is quick, slow parts exact: S y + S (1 - S) y + S (1 - S)^2 y, for S y the
    path x of least sum of w |x - y|^2 + s |x'''|^2. Where `weight (T)` w is 1, S keeps half at `hz`."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    stiff = float((2 * np.sin(np.pi * min(hz / fps, 0.5))) ** -6)
    weight = weight + 1e-9 * (1.0 + stiff)
    band = np.zeros((4, len(y)))
    band[0] = weight
    _add(band, _THIRD, stiff, len(y), 1, 0)
    factor, out = cholesky_banded(band, lower=True), np.zeros_like(y)
    for _ in range(3):
        out = out + cho_solve_banded((factor, True), (y - out) * weight[:, None])
    return out


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
    """The tremble n, for white noise s of size 1 and a tremble of variance `size`:

    min over x, n   sum |y - x - n|^2 / s^2 + lambda |x'''|^2
                        + |n_t+1 - 2 r cos(w) n_t + r^2 n_t-1|^2 / q.
    """
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
            band[..., stride * (i - j), at] += weight * row[i] * row[j]


@lru_cache(maxsize=64)
def spline(frames: int, stiff: float) -> np.ndarray:
    """The Cholesky factor, lower banded, of a smoothing spline of stiffness lambda."""
    from scipy.linalg import cholesky_banded

    band = np.zeros((4, frames))
    band[0] = 1.0
    _add(band, _THIRD, stiff, frames, 1, 0)
    return cholesky_banded(band, lower=True)


def smoothed(y: np.ndarray, fps: float, groups: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """The channels without white noise of variance `floor (G)`, the sum over a group's channels.

    Each is the mean of smoothing splines of many stiffnesses lambda, weighted in every frame by how near
    to the truth Stein's unbiased estimate says they are, around the frame and over the clip:

        risk = |y - S y|^2 / s^2 + 2 tr(S) / T.
    """
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


def smoothstep(u: Array) -> Array:
    """From 0 to 1 as `u` does, level at both ends."""
    return u * u * (3.0 - 2.0 * u)


def find_runs(bad: np.ndarray, gap: int) -> list[tuple[int, int]]:
    """First and last index of every run of true in `bad (T)`; runs at most `gap` apart are one."""
    at = np.flatnonzero(bad)
    if not len(at):
        return []
    return [(int(s[0]), int(s[-1])) for s in np.split(at, np.flatnonzero(np.diff(at) > gap + 1) + 1)]


def gaussian(sigma: float, reach: int | None = None) -> np.ndarray:
    """Weights of sum 1 over +-`reach` frames, by default three deviations `sigma`."""
    reach = max(1, math.ceil(3 * sigma)) if reach is None else reach
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    return kernel / kernel.sum()


def gaussian_sums(path: np.ndarray, sigma: float) -> tuple[np.ndarray, float, int]:
    """Weighted sums `(T, n)` of `path (T, n)` over three deviations `sigma`, the ends held; the sum of
    the weights; and the reach in frames."""
    reach = math.ceil(3 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    padded = np.pad(path, ((reach, reach), (0, 0)), mode="edge")
    sums = sliding_window_view(padded, 2 * reach + 1, axis=0) @ kernel
    return sums, float(kernel.sum()), reach


def fade_beside(frames: int, start: int, stop: int, reach: int) -> np.ndarray:
    """`(T)` 1 in the frames `start` to `stop`, falling to 0 over `reach` frames beside them."""
    at = np.arange(frames, dtype=float)
    away = np.clip(np.maximum(start - at, at - stop), 0, reach) / reach
    return 0.5 + 0.5 * np.cos(math.pi * away)


def smooth_lift(depth: np.ndarray, fps: float, seconds: float, cyclic: bool = False) -> np.ndarray:
    """The smooth lift `(T,)` that covers `depth (T,)`, both in m, spread over +-`seconds`."""
    return np.maximum(smooth_hull(depth, max(1, round(seconds * fps)), cyclic), 0.0)


def smooth_hull(values: np.ndarray, reach: int, cyclic: bool) -> np.ndarray:
    """The running maximum of `values (T,)` over +-reach frames, averaged over as many."""
    if cyclic:
        # The last frame is the first one again, so it counts once.
        values = np.maximum(values[:-1], np.append(values[-1], values[1:-1]))
    mode = "wrap" if cyclic else "edge"
    # SciPy's maximum filter takes 0.2 s to load, which `poise info` need not wait for.
    hull = sliding_window_view(np.pad(values, reach, mode=mode), 2 * reach + 1).max(-1)
    window = np.hanning(2 * reach + 3)[1:-1]
    padded = np.pad(hull, reach, mode=mode)
    smooth = np.convolve(padded, window / window.sum(), "valid")
    return np.append(smooth, smooth[0]) if cyclic else smooth
