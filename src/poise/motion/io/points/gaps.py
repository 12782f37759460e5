"""Points that a file writes as 0 0 0 where they were not seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from poise.motion.io.text import listed
from poise.motion.points.clean import runs
from poise.motion.points.labels import middle_label

#: A point may be at the origin if the frame before or after finds it nearer than this share of the body.
_NEAR = 0.1


def without_zeros(names: Sequence[str], positions: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Positions `(T, K, 3)` with NaN where exact zeros stand for a missing point, and a note about them.

    A point that comes from near the origin or goes there is one. So is the middle of a body (pelvis,
    neck, ...) that is always there while the others are around it: the origin of points that are told
    relative to it.
    """
    zero = (positions == 0.0).all(-1)
    if not zero.any():
        return positions, []
    known = np.where(zero[..., None], np.nan, positions)
    seen = known[~np.isnan(known).any(-1).all(-1)]
    if not len(seen):
        return positions, []
    size = float(np.median(np.linalg.norm(_extent(seen), axis=-1)))
    missing = zero.copy()
    for k in map(int, np.flatnonzero(zero.any(0))):
        if zero[:, k].all():
            missing[:, k] = not (middle_label(names[k]) and _around_origin(seen, size))
            continue
        far = np.linalg.norm(np.where(zero[:, k, None], np.nan, positions[:, k]), axis=-1)
        for start, stop in runs(zero[:, k]):
            beside = [far[i] for i in (start - 1, stop) if 0 <= i < len(far)]
            missing[start:stop, k] = not any(d < _NEAR * size for d in beside)
    if not missing.any():
        return positions, []
    counts = missing.sum(0)
    told = listed(
        (f"{names[k]} {counts[k]}" for k in np.argsort(-counts, kind="stable") if counts[k]), 6
    )
    note = (
        f"{int(counts.sum())} of {missing.size} points are written as 0 0 0 where they are missing: "
        f"they were not taken as places ({told})"
    )
    return np.where(missing[..., None], np.nan, positions), [note]


def _extent(points: np.ndarray) -> np.ndarray:
    """`(T, 3)` how far the known points `(T, K, 3)` reach along each axis; each frame has one."""
    return np.nanmax(points, axis=1) - np.nanmin(points, axis=1)


def _around_origin(points: np.ndarray, size: float) -> bool:
    """Whether the known points `(T, K, 3)` lie around the origin in nearly all frames."""
    low, high = np.nanmin(points, axis=1), np.nanmax(points, axis=1)
    slack = _NEAR * size
    return bool(((low < slack) & (high > -slack)).all(-1).mean() > 0.95)
