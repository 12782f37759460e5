"""Rotations of one frame in numpy, wxyz: small arrays, for which torch takes most of a control step.

The functions are those of `poise.motion.rotations`, by which the tests check them.
"""

from __future__ import annotations

import numpy as np


def _products(width: int, signs: dict[tuple[int, int], tuple[int, float]], count: int) -> np.ndarray:
    """`(width^2, count)`: what each product of two coordinates (i, j) adds to, and how often."""
    out = np.zeros((width * width, count))
    for (i, j), (k, sign) in signs.items():
        out[width * i + j, k] += sign
    return out


#: Which products a_i b_j make up a b, and u_i v_j make up u x v: one product of matrices takes a tenth
#: of the time that some thirty operations on small arrays take.
_MUL = _products(4, {
    (0, 0): (0, 1.0), (1, 1): (0, -1.0), (2, 2): (0, -1.0), (3, 3): (0, -1.0),
    (0, 1): (1, 1.0), (1, 0): (1, 1.0), (2, 3): (1, 1.0), (3, 2): (1, -1.0),
    (0, 2): (2, 1.0), (2, 0): (2, 1.0), (1, 3): (2, -1.0), (3, 1): (2, 1.0),
    (0, 3): (3, 1.0), (3, 0): (3, 1.0), (1, 2): (3, 1.0), (2, 1): (3, -1.0),
}, 4)  # fmt: skip
_CROSS = _products(3, {
    (1, 2): (0, 1.0), (2, 1): (0, -1.0), (2, 0): (1, 1.0), (0, 2): (1, -1.0),
    (0, 1): (2, 1.0), (1, 0): (2, -1.0),
}, 3)  # fmt: skip
_CONJ = np.array([1.0, -1.0, -1.0, -1.0])


def mul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The product a b, `(..., 4)`."""
    every = a[..., :, None] * b[..., None, :]
    return every.reshape(*every.shape[:-2], 16) @ _MUL


def conj(q: np.ndarray) -> np.ndarray:
    """The inverse of unit quaternions."""
    return q * _CONJ


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a^-1 b."""
    return mul(conj(a), b)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors `(..., 3)` turned by q, v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * _cross(u, v)
    return v + w * t + _cross(u, t)


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    every = u[..., :, None] * v[..., None, :]
    return every.reshape(*every.shape[:-2], 9) @ _CROSS


def normalized(q: np.ndarray) -> np.ndarray:
    """Unit quaternions."""
    return q / np.sqrt((q * q).sum(-1, keepdims=True))


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
    w, x, y, z = (q[..., k] for k in range(4))
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
