"""Keypoints and tracks without spikes, gaps and the noise of the estimator that found them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from poise.formats.markers import SIDES
from poise.formats.text import listed
from poise.motion.smoothing import (
    HIGHEST_HZ,
    LINES,
    RESOLVED,
    SHORTEST,
    TREMBLES,
    WHITE_MM,
    Spectrum,
    faded,
    pieces,
    smoothed,
    tremble_of,
    white_mm,
)

SPIKE_M, SPIKE_TIMES, SPIKE_ACCELERATION = 0.05, 9.0, 100.0
"""A spike deviates from the median of its five frames by more than 5 cm, nine times the median deviation
of the second around it, and what 100 m/s^2 would explain."""
_HALF_WINDOW = 2
#: Numbers in the windows of one piece of a running median.
_PIECE = 2_000_000


def drop_spikes(positions: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions `(T, K, 3)` with spikes as NaN, and where they were `(T, K)`.

    Hampel's filter: the deviation from a running median over five frames is compared with its own
    running median over one second. Missing frames stay missing.
    """
    frames = len(positions)
    spikes = np.zeros(positions.shape[:2], dtype=bool)
    if frames < 2 * _HALF_WINDOW + 1:
        return positions, spikes
    explained = 0.5 * SPIKE_ACCELERATION * (_HALF_WINDOW / fps) ** 2
    path = _path(positions.reshape(frames, -1)).reshape(positions.shape)
    off, limit = np.linalg.norm(positions - path, axis=-1), max(SPIKE_M, explained)
    found = off > limit
    # Of the others, which are nearly all, nobody asks what is usual there.
    usual = _medians(off, found, max(_HALF_WINDOW, round(0.5 * fps)))
    least = np.full_like(off, limit)
    least[found] = np.maximum(limit, SPIKE_TIMES * usual)
    found = off > least
    # At the ends nothing tells a spike from a step.
    found[:_HALF_WINDOW] = found[-_HALF_WINDOW:] = False
    for k in np.flatnonzero(found.any(0)):
        # In fast motion a spike bends the median beside it; what lies on the path of the rest stays.
        rest = fill(np.where(found[:, k, None], np.nan, positions[:, k]))
        spikes[:, k] = found[:, k] & (np.linalg.norm(positions[:, k] - rest, axis=-1) > least[:, k])
    out = positions.copy()
    out[spikes] = np.nan
    return out, spikes


def _path(x: np.ndarray) -> np.ndarray:
    """Median `(T, C)` over five frames (fewer at the ends), NaN skipped."""
    middle = slice(_HALF_WINDOW, len(x) - _HALF_WINDOW)
    missing = np.isnan(x).any()
    asked = np.ones(x.shape, dtype=bool)
    asked[middle] = missing
    out = np.empty_like(x)
    out[asked] = _medians(x, asked, _HALF_WINDOW)
    if not missing:
        a, b, c, d, e = (x[k : len(x) - 4 + k] for k in range(5))
        # Neither the least nor the largest of four is it: of the two that are left and the fifth the
        # middle one is.
        low = np.maximum(np.minimum(a, b), np.minimum(c, d))
        high = np.minimum(np.maximum(a, b), np.maximum(c, d))
        out[middle] = np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), e))
    return out


def _medians(x: np.ndarray, asked: np.ndarray, half: int) -> np.ndarray:
    """Medians `(N)` of `x (T, C)` over frames t - half to t + half (fewer at the ends) where they are
    `asked (T, C)`, NaN skipped."""
    half = min(half, len(x) - 1)
    padded = np.pad(x, ((half, half), (0, 0)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, 0)
    frames, columns = np.nonzero(asked)
    out = np.full(len(frames), np.nan)
    # Many go in pieces, so that the windows of one piece fit into little memory.
    piece = max(1, _PIECE // (2 * half + 1))
    for start in range(0, len(out), piece):
        here = slice(start, start + piece)
        # NaN is sorted to the end, so the known values of a window are its first `count`.
        ordered = np.sort(windows[frames[here], columns[here]], axis=-1)
        count = (~np.isnan(ordered)).sum(-1, keepdims=True)
        low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, -1)
        high = np.take_along_axis(ordered, np.minimum(count // 2, 2 * half), -1)
        out[here] = ((low + high) / 2)[..., 0]
    return out


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """`(start, stop)` of every run of True in `mask (T,)`."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def longest_stretch(missing: np.ndarray, longest_gap: int) -> tuple[int, int]:
    """`(start, stop)` of the longest run of frames with gaps that can be filled.

    missing: `(T, K)`. Gaps of more than `longest_gap` frames in any column interrupt it, and so do
    missing
    frames at either end of the recording: there is nothing behind them to interpolate to.
    """
    bad = np.zeros(len(missing), dtype=bool)
    for column in missing.T:
        for start, stop in runs(column):
            if stop - start > longest_gap or start == 0 or stop == len(missing):
                bad[start:stop] = True
    whole = runs(~bad)
    return max(whole, key=lambda r: r[1] - r[0]) if whole else (0, 0)


def fill(values: np.ndarray) -> np.ndarray:
    """Values `(T, C)` with gaps interpolated linearly; before the first and after the last they hold."""
    known = ~np.isnan(values).any(-1)
    if known.all() or not known.any():
        return values
    at = np.arange(len(values))
    columns = [np.interp(at, at[known], values[known, c]) for c in range(values.shape[1])]
    return np.stack(columns, -1)


def smooth(values: np.ndarray, fps: float, cutoff_hz: float) -> np.ndarray:
    """Values `(T, ...)` through a zero-phase Gaussian low-pass, its gain 1/sqrt(2) at `cutoff_hz`.

    The gain of a Gaussian of width sigma (s) at f is exp(-2 pi^2 sigma^2 f^2). The ends are continued
    point-symmetrically, which keeps their speed.
    """
    sigma = np.sqrt(np.log(2.0)) / (2.0 * np.pi * cutoff_hz) * fps
    half = min(max(1, int(np.ceil(4.0 * sigma))), len(values) - 1)
    if half < 1:
        return values
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / max(sigma, 1e-9)) ** 2)
    kernel /= kernel.sum()
    flat = values.reshape(len(values), -1)
    padded = np.pad(flat, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    out = np.zeros_like(flat)
    for k, weight in enumerate(kernel):
        out += weight * padded[k : k + len(flat)]
    return out.reshape(values.shape)


def spike_note(names: tuple[str, ...], spikes: np.ndarray) -> list[str]:
    """The sentence about spikes that were taken out, worst keypoints first."""
    counts = spikes.sum(0)
    if not counts.any():
        return []
    order = [k for k in np.argsort(-counts) if counts[k]]
    return [
        f"{int(counts.sum())} of {spikes.size} keypoint samples jump out of their path and back: they "
        f"were taken as missing ({listed((f'{names[k]} {counts[k]}' for k in order), 6)})"
    ]


#: Bones of which both ends are needed places.
BONES = (
    ("left_hip", "right_hip"),
    *((f"{s}_{a}", f"{s}_{b}") for s in SIDES for a, b in pairwise(("hip", "knee", "ankle"))),
    *((f"{s}_{a}", f"{s}_{b}") for s in SIDES for a, b in pairwise(("shoulder", "elbow", "wrist"))),
)
#: Below this (Hz) people have tones of their own, and a tremble has to stand in the bones' lengths: that
#: of two ends that tremble by themselves has a third of their variances, and is to have this share of it
#: on average.
SURE_HZ, IN_BONES = 3.5, 0.4
#: With a smaller share the bones stay as they are: a rigid body moves so, if it trembles, as joints do.
RIGID = 0.05
#: A smaller tremble (mm) at a frequency is none.
LEAST_MM = 3.0
#: A frequency is clear at which the bones change by this times the median power.
CLEAR = 6.0


@dataclass(frozen=True)
class RemovedTremble:
    """A tremble that was taken off: mm (rms over places), and Hz, None from frame to frame."""

    size_mm: float
    hz: float | None

    @property
    def how(self) -> str:
        """Its frequency in words, such as "at 5.0 Hz"."""
        return "from frame to frame" if self.hz is None else f"at {self.hz:.1f} Hz"


def still(
    tracks: Mapping[str, np.ndarray], fps: float
) -> tuple[dict[str, np.ndarray], RemovedTremble | None]:
    """The tracks `(T, 3)` m of the places of a body without their noise, and what it was; None where
    there is none, and the tracks as they are. A long recording is told and smoothed by pieces.

    Noise is told as that of joints is (`motion.smoothing.Spectrum`), and by the bones: they keep their
    lengths when a body moves, whatever it does, and do not when each keypoint trembles by itself.
    """
    names = list(tracks)
    places = np.stack([tracks[name] for name in names], 1)
    frames = len(places)
    bones = [(names.index(a), names.index(b)) for a, b in BONES]
    out, worst = places.copy(), None
    for here in pieces(frames, fps):
        found = _piece(places[here], fps, bones)
        if found is None:
            continue
        share = faded(here, frames, fps)[:, None, None]
        out[here] += share * (found[0] - places[here])
        worst = max(found[1], worst or found[1], key=_size)
    if worst is None:
        return dict(tracks), None
    return {name: out[:, k] for k, name in enumerate(names)}, worst


def _piece(
    places: np.ndarray, fps: float, bones: list[tuple[int, int]]
) -> tuple[np.ndarray, RemovedTremble] | None:
    """A piece `(T, K, 3)` without its noise and that, None where it has none."""
    frames, count = places.shape[:2]
    if frames < SHORTEST:
        return None
    groups, calm = np.repeat(np.arange(count), 3), places.reshape(frames, -1)
    found: RemovedTremble | None = None
    for _ in range(LINES):
        spectrum = Spectrum.of(calm, fps, groups)
        # Of a tremble that is gone the bones keep what their turning made of it, at other frequencies.
        told = _tone(
            spectrum, calm.reshape(places.shape), bones, HIGHEST_HZ if found is None else SURE_HZ
        )
        if told is None:
            break
        hz, size = told
        found = max(
            found or RemovedTremble(0.0, hz), RemovedTremble(1e3 * math.sqrt(size), hz), key=_size
        )
        calm = calm - tremble_of(calm, groups, spectrum, hz, size)[0]
    white = white_mm(places, fps) if found is None else 0.0
    if found is None and white < WHITE_MM:
        return None
    floor = Spectrum.of(calm, fps, groups).floor()
    calm = smoothed(calm, fps, groups, floor)
    return calm.reshape(places.shape), found or RemovedTremble(white, None)


def _tone(
    spectrum: Spectrum, places: np.ndarray, bones: list[tuple[int, int]], top: float
) -> tuple[float, float] | None:
    """The frequency (Hz) at which the keypoints tremble, and the variance of that (m^2, all axes); None
    where they do not. Up to `top` (Hz) the bones alone may tell it."""
    hz = spectrum.tremble()
    lengths = np.stack([np.linalg.norm(places[:, a] - places[:, b], axis=-1) for a, b in bones], -1)
    of_bones = Spectrum.of(lengths, spectrum.fps, np.arange(len(bones)))
    for one in (hz, _clearest(of_bones, top)):
        if one is None:
            continue
        moves, changes = spectrum.tone(one)[0], of_bones.tone(one)[0]
        both = np.array([moves[a] + moves[b] for a, b in bones]) / 3.0
        in_bones = float(np.minimum(changes / np.maximum(both, 1e-300), 2.0).mean())
        if in_bones >= IN_BONES:
            # The body's own motion at that frequency is no tremble.
            size = min(1.5 * float(changes.mean()), float(moves.mean()))
        elif one >= SURE_HZ and in_bones >= RIGID:
            size = float(moves.mean())
        else:
            continue
        return (one, size) if 1e3 * math.sqrt(size) >= LEAST_MM else None
    return None


def _clearest(lengths: Spectrum, top: float) -> float | None:
    """The frequency (Hz) at which the bones' lengths change most, None where they have no such."""
    low, high = max(TREMBLES[0][0], RESOLVED * lengths.width), 0.42 * lengths.fps
    band = (lengths.hz >= low) & (lengths.hz <= high)
    power = lengths.power[band]
    if not len(power) or not power.any():
        return None
    every = (power / np.maximum(power.mean(0), 1e-300)).mean(1)
    peak = int(every.argmax())
    hz = float(lengths.hz[band][peak])
    clear = every[peak] >= CLEAR * np.median(every) and 0 < peak < len(every) - 1
    return hz if clear and hz < top else None


def _size(tremble: RemovedTremble) -> float:
    return tremble.size_mm
