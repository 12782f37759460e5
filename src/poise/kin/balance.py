"""Balance: where the floor's force must act under a motion, and what could bear it there."""

from __future__ import annotations

import math

import numpy as np

from poise.kin.series import gaussian
from poise.metrics.shapes import PIECE
from poise.spatial import GRAVITY

#: Standard deviation (s) of the low-pass on the centre of mass before it is differentiated twice.
SMOOTH_S = 0.1
#: Least upward force over weight at which a balance point says anything; below, the body nearly falls.
LEAST_WEIGHT = 0.5
#: Directions in which the support is measured; between two of them it is 0.5 % off.
DIRECTIONS = 32
_ANGLES = 2 * math.pi * np.arange(DIRECTIONS) / DIRECTIONS
_WAYS = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)))


def balance_point(
    com: np.ndarray, fps: float, smooth_s: float = SMOOTH_S
) -> tuple[np.ndarray, np.ndarray]:
    """Zero moment point `(T, 2)` m on z = 0 of a centre of mass `(T, 3)` m, and force over weight `(T)`.

    p = c_xy - c_z c''_xy / (g + c''_z) is the point about which the floor's force has no horizontal
    moment (Vukobratovic), without the body's own spin. The path is smoothed by a Gaussian of `smooth_s`,
    going on beyond its ends as it comes.
    """
    reach = min(round(4 * smooth_s * fps), len(com) - 1)
    kernel = gaussian(smooth_s * fps, reach)
    # An odd reflection keeps the speed at the ends, where an even one would stop the body.
    padded = np.pad(com, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    smooth = np.stack([np.convolve(x, kernel, "valid") for x in padded.T], -1)
    acc = np.gradient(np.gradient(smooth, axis=0), axis=0) * fps**2
    up = GRAVITY + acc[:, 2]
    held = np.maximum(up, LEAST_WEIGHT * GRAVITY)
    return smooth[:, :2] - (smooth[:, 2] / held)[:, None] * acc[:, :2], up / GRAVITY


def hull_distance(points: np.ndarray, mask: np.ndarray, at: np.ndarray) -> np.ndarray:
    """`(T)` m, how far `at (T, 2)` lies outside the hull of `points (T, P, 2)` under `mask (T, P)`.

    Inside it is negative; without any point it is infinite.
    """
    return beyond_reach(hull_reach(points, mask), at)


def hull_reach(points: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """`(T, DIRECTIONS)` m, max_p d . p over `points (T, P, 2)` under `mask (T, P)` for each unit
    direction d; minus infinity without any point."""
    # All frames of an hour at once would take gigabytes.
    parts = [slice(k, k + PIECE) for k in range(0, len(points), PIECE)]
    return np.concatenate([np.where(mask[p, :, None], points[p] @ _WAYS, -np.inf).max(1) for p in parts])


def beyond_reach(reach: np.ndarray, at: np.ndarray) -> np.ndarray:
    """`(T)` m, how far `at (T, 2)` lies outside a convex set of a `reach (T, DIRECTIONS)`, see
    `hull_reach`: max_d (d . at - reach_d)."""
    return (at @ _WAYS - reach).max(-1)
