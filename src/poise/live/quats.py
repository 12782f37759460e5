"""Rotations of one frame in numpy, wxyz: small arrays, for which torch takes most of a control step.

The functions are those of `poise.spatial`, by which the tests check them.
"""

from __future__ import annotations

import numpy as np


def mul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The product a b, `(..., 4)`."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    out = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return np.stack(out, -1)


def conj(q: np.ndarray) -> np.ndarray:
    """The inverse of unit quaternions."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a^-1 b."""
    return mul(conj(a), b)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors `(..., 3)` turned by q, v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def normalized(q: np.ndarray) -> np.ndarray:
    """Unit quaternions."""
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def slerp(a: np.ndarray, b: np.ndarray, share: np.ndarray | float) -> np.ndarray:
    """From a to b the short way; shares beyond 1 go on turning."""
    dot = (a * b).sum(-1, keepdims=True)
    b = np.where(dot < 0, -b, b)
    half = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    share = np.asarray(share, dtype=float)[..., None] if np.ndim(share) else share
    small = half < 1e-6
    sine = np.where(small, 1.0, np.sin(half))
    left = np.where(small, 1.0 - share, np.sin((1.0 - share) * half) / sine)
    right = np.where(small, share, np.sin(share * half) / sine)
    return normalized(left * a + right * b)


def matrix(q: np.ndarray) -> np.ndarray:
    """`(..., 3, 3)`."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return np.stack(rows, -1).reshape(*q.shape[:-1], 3, 3)


def yaw(angle: float) -> np.ndarray:
    """A turn about +Z."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def heading(q: np.ndarray) -> float:
    """rad about +Z by which +X is turned."""
    w, x, y, z = q
    return float(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
