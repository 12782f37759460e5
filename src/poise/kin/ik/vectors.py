"""Vectors and frames in NumPy for inverse kinematics: small batches, so few and plain operations."""

from __future__ import annotations

import numpy as np

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b `(..., 3)`."""
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a . b `(..., 1)`."""
    return np.einsum("...i,...i->...", a, b)[..., None]


def norm(a: np.ndarray) -> np.ndarray:
    """|a| `(..., 1)`."""
    return np.sqrt(np.einsum("...i,...i->...", a, a))[..., None]


def unit(a: np.ndarray) -> np.ndarray:
    """a / |a| `(..., 3)`; zero stays zero."""
    return a / np.maximum(norm(a), 1e-300)


def across(a: np.ndarray) -> np.ndarray:
    """Some unit vector `(..., 3)` square to `a`."""
    least = np.abs(a).argmin(-1)
    return unit(cross(a, np.eye(3)[least]))


def square_to(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The part of `a (..., 3)` square to unit `b`; some vector across b where nothing remains."""
    rest = a - dot(a, b) * b
    lost = norm(rest) < 1e-9 * (norm(a) + 1e-300)
    return np.where(lost, across(b), rest) if lost.any() else rest


def columns(*axes: np.ndarray) -> np.ndarray:
    """Matrices `(..., 3, 3)` whose columns are `axes`."""
    return np.stack(axes, -1)


def frame_of(
    hold: str,
    x: np.ndarray | None = None,
    y: np.ndarray | None = None,
    z: np.ndarray | None = None,
) -> np.ndarray:
    """Orthonormal `(..., 3, 3)` of two directions; axis `hold` is kept, the other made square to it."""
    given = {"x": x, "y": y, "z": z}
    kept = given.pop(hold)
    name, other = next((k, v) for k, v in given.items() if v is not None)
    assert kept is not None
    kept = unit(kept)
    axes = {hold: kept, name: unit(square_to(other, kept))}
    # The third axis closes the cycle x, y, z.
    last = next(k for k in "xyz" if k not in axes)
    after = "yzx"["xyz".index(last)]
    axes[last] = cross(axes[after], axes["xyz"[("xyz".index(last) + 2) % 3]])
    return columns(axes["x"], axes["y"], axes["z"])


def rotate(m: np.ndarray, v: np.ndarray) -> np.ndarray:
    """m v `(..., 3)`."""
    return (m @ v[..., None])[..., 0]


def arc(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Matrices `(..., 3, 3)` of the smallest turn that brings unit `a (..., 3)` onto unit `b`."""
    v, c = cross(a, b), dot(a, b)[..., None]
    # R = I + [v] + [v]^2 / (1 + a . b); half a turn about an axis across where a = -b
    k = np.zeros((*v.shape[:-1], 3, 3))
    k[..., 2, 1], k[..., 0, 2], k[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    k -= np.swapaxes(k, -1, -2)
    opposite = c < -1.0 + 1e-12
    out = np.eye(3) + k + k @ k / np.where(opposite, 1.0, 1.0 + c)
    if opposite.any():
        n = across(a)
        out = np.where(opposite, 2.0 * n[..., :, None] * n[..., None, :] - np.eye(3), out)
    return out


def prefix_product(m: np.ndarray) -> np.ndarray:
    """m_t ... m_1 m_0 for every t `(T, ..., 3, 3)` in log2(T) passes (Hillis and Steele 1986)."""
    out, reach = m.copy(), 1
    while reach < len(out):
        out = np.concatenate((out[:reach], out[reach:] @ out[:-reach]))
        reach *= 2
    return out
