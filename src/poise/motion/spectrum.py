"""Noise told from motion by its spectrum: how much every channel trembles, and at which frequencies.

People's joints are slow: above some 2 Hz the spectrum of every joint falls with frequency, and a gait
has more power an octave below than in its harmonics. Noise does neither. White noise ends that fall at
a floor that all joints reach; a tremble stands out of the octave below it and the octave above it, in
most joints at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

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
        raw = np.abs(np.fft.rfft(y * window[:, None], size, axis=0)) ** 2 / (window**2).sum()
        power = np.zeros((len(raw), int(groups.max()) + 1))
        np.add.at(power.T, groups, raw.T)
        return cls(np.fft.rfftfreq(size, 1 / fps), raw, power, 2.0 * fps / frames, fps)

    def near(self, hz: float) -> np.ndarray:
        """Where a tone of `hz` has its peak."""
        return np.abs(self.hz - hz) <= max(0.06, 0.25 * self.width)

    def floor(self) -> np.ndarray:
        """`(G)` variance of the white noise in each group: the mean over the bands that are flat."""
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
        """The frequency (Hz) of the clearest tremble, None without any."""
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
