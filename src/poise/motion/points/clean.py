"""Keypoints without spikes, gaps and (where asked for) what is fast."""

from __future__ import annotations

import numpy as np

from poise.motion.io.text import listed

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
    path = _running_median(positions.reshape(frames, -1), _HALF_WINDOW).reshape(positions.shape)
    off = np.linalg.norm(positions - path, axis=-1)
    usual = _running_median(off, max(_HALF_WINDOW, round(0.5 * fps)))
    limit = np.maximum(max(SPIKE_M, explained), SPIKE_TIMES * usual)
    found = off > limit
    # At the ends nothing tells a spike from a step.
    found[:_HALF_WINDOW] = found[-_HALF_WINDOW:] = False
    for k in np.flatnonzero(found.any(0)):
        # In fast motion a spike bends the median beside it; what lies on the path of the rest stays.
        rest = fill(np.where(found[:, k, None], np.nan, positions[:, k]))
        spikes[:, k] = found[:, k] & (np.linalg.norm(positions[:, k] - rest, axis=-1) > limit[:, k])
    out = positions.copy()
    out[spikes] = np.nan
    return out, spikes


def _running_median(x: np.ndarray, half: int) -> np.ndarray:
    """Median `(T, C)` over frames t - half to t + half (fewer at the ends), NaN skipped."""
    half = min(half, len(x) - 1)
    padded = np.pad(x, ((half, half), (0, 0)), constant_values=np.nan)
    out = np.full_like(x, np.nan)
    # Long recordings go in pieces, so that the windows of one piece fit into little memory.
    piece = max(1, _PIECE // (x.shape[1] * (2 * half + 1)))
    for start in range(0, len(x), piece):
        stop = min(start + piece, len(x))
        windows = np.lib.stride_tricks.sliding_window_view(
            padded[start : stop + 2 * half], 2 * half + 1, 0
        )
        # NaN is sorted to the end, so the known values of a window are its first `count`.
        ordered = np.sort(windows, axis=-1)
        count = (~np.isnan(windows)).sum(-1, keepdims=True)
        low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, -1)
        high = np.take_along_axis(ordered, np.minimum(count // 2, 2 * half), -1)
        out[start:stop] = ((low + high) / 2)[..., 0]
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
