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
#: From a frequency (Hz) on a tremble has this many times the largest power of the octave below, in all
#: channels but the share `MOST`. What is slower has such peaks of its own: a gait's first harmonic has
#: little below it.
TREMBLES = ((1.6, 2.0), (2.5, 0.8), (3.5, 0.42))
MOST = 0.4
#: And as many times the largest power of the octave above, times this.
ABOVE = 8.0
#: A tremble is told apart from this many widths of a tone on.
RESOLVED = 1.9
#: The highest tremble (Hz) that is looked for by itself; what is faster counts as white noise.
HIGHEST_HZ = 15.0
#: White noise (mm, rms over joints) from which a motion trembles: clean ones have up to 4, where it is
#: fast, at 30 frames/s. Where the highest bands begin below this frequency (Hz) they hold motion.
WHITE_MM, WHITE_HZ = 5.0, 6.0
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
        alive = self.channels[:, self.channels.sum(0) > 1e-10 * self.channels.sum(0).max()]
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
        peak = np.maximum(power[at], np.maximum(power[at - 1], power[np.minimum(at + 1, count - 1)]))
        over, under = (
            np.quantile(peak / np.maximum(_largest(power, *span), 1e-30), MOST, axis=1) for span in spans
        )
        starts, limits = np.array(TREMBLES).T
        limit = limits[np.searchsorted(starts, hz[at] + 1e-9) - 1]
        clear = np.minimum(over, under / ABOVE) / limit
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
        # A tone a sin(2 pi f t) under a Hann window of T frames has a peak of a^2 T / 6.
        seconds = 2.0 / self.width
        return 3.0 * np.maximum(peak - rest, 0.0) / (seconds * self.fps), rest + np.zeros_like(peak)


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
    return 1e3 * math.sqrt(min(floor, usual))
