"""Arrays of NumPy where files are read and mended, tensors of torch where bodies are simulated.

A function of both takes either and returns what it was given. It names operations by the array API
standard, in the namespace of its arrays (`namespace`); the few here are those with a kernel that is
faster than the standard's. Torch is not imported until a tensor comes, so that files need none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

#: An array of NumPy or a tensor; all arrays of one call are of one kind, and so is what it returns. The
#: two share operators and indices, and no type that says so.
Array: TypeAlias = Any

_PLAIN = (np.ndarray, np.generic, float, int)
_SPACES: dict[type, Any] = {}


def namespace(array: Any) -> Any:
    """The functions of the array API standard for arrays like this one."""
    if isinstance(array, _PLAIN):
        return np  # NumPy 2 follows the standard by itself.
    found = _SPACES.get(type(array))
    if found is None:
        from array_api_compat import array_namespace

        found = _SPACES[type(array)] = array_namespace(array)
    return found


_MADE: dict[Any, tuple[Sequence[Any], Any]] = {}
_DOUBLE = np.dtype(np.float64)


def constant_like(rows: Sequence[Any], array: Any) -> Any:
    """Numbers in (nested) tuples as an array of the kind, dtype and device of `array`.

    It is made once for each kind and shared, so do not write on it. `rows` is known by its identity,
    since to hash what it holds takes as long as a product: hand in a constant.
    """
    plain = type(array) is np.ndarray and array.dtype is _DOUBLE
    key = id(rows) if plain else (id(rows), array.dtype, array.device)
    made = _MADE.get(key)
    if made is None or made[0] is not rows:
        out = namespace(array).asarray(rows, dtype=array.dtype, device=array.device)
        if isinstance(out, np.ndarray):
            out.flags.writeable = False
        made = _MADE[key] = rows, out
    return made[1]


def like(values: Any, array: Array) -> Array:
    """`values` as an array of the kind, dtype and device of `array`."""
    xp: Any = namespace(array)
    # A tensor that shared the memory of an array could be written on where that one may not be.
    copy = True if isinstance(values, np.ndarray) and xp is not np else None
    return xp.asarray(values, dtype=array.dtype, device=array.device, copy=copy)


def norm(v: Array, keepdims: bool = False) -> Array:
    """Lengths of the vectors along the last axis."""
    if isinstance(v, np.ndarray):
        out = np.sqrt(np.einsum("...i,...i->...", v, v))
        return np.asarray(out)[..., None] if keepdims else out
    return v.norm(dim=-1, keepdim=keepdims)


def floored(v: Array, least: float) -> Array:
    """The larger of `v` and `least`."""
    return np.maximum(v, least) if isinstance(v, np.ndarray | np.generic) else v.clamp_min(least)


def limited(v: Array, least: float | None = None, most: float | None = None) -> Array:
    """`v` within `least` and `most`."""
    if not isinstance(v, np.ndarray | np.generic):
        return v.clamp(least, most)
    v = v if least is None else np.maximum(v, least)
    return v if most is None else np.minimum(v, most)


#: Row 3 i + j holds what u_i v_j adds to u x v.
_CROSS = (
    (0, 0, 0), (0, 0, 1), (0, -1, 0),
    (0, 0, -1), (0, 0, 0), (1, 0, 0),
    (0, 1, 0), (-1, 0, 0), (0, 0, 0),
)  # fmt: skip


#: Numbers from which on arrays of NumPy are multiplied component by component. For fewer the passes
#: cost more than their arithmetic, and one outer product with a small matrix takes their place.
LARGE = 2000


def parts(a: np.ndarray, b: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """The components along the last axes of two arrays with leading dimensions that broadcast, and an
    array for a product as wide as `b`, which lies in memory as they do."""
    wide, kind = b.shape[-1], np.result_type(a, b)
    if b.ndim == 1 or b.shape[:-1] == a.shape[:-1]:
        out = np.empty_like(a[..., :wide], kind)
    elif a.ndim == 1:
        out = np.empty_like(b, kind)
    else:
        out = np.empty((*np.broadcast_shapes(a.shape[:-1], b.shape[:-1]), wide), kind)
    return [a[..., k] for k in range(a.shape[-1])], [b[..., k] for k in range(b.shape[-1])], out


def cross(u: Array, v: Array) -> Array:
    """u x v of vectors `(..., 3)` that broadcast."""
    if isinstance(u, np.ndarray):
        if u.size >= LARGE or v.size >= LARGE:
            (a, b, c), (x, y, z), out = parts(u, v)
            out[..., 0], out[..., 1], out[..., 2] = b * z - c * y, c * x - a * z, a * y - b * x
            return out
        outer = u[..., :, None] * v[..., None, :]
        return outer.reshape(*outer.shape[:-2], 9) @ constant_like(_CROSS, outer)
    import torch

    # The same number of dimensions is asked for.
    return torch.linalg.cross(*((u, v) if u.ndim == v.ndim else torch.broadcast_tensors(u, v)))


def lower_median(v: np.ndarray, axis: int | None = None) -> np.ndarray:
    """The median, of two in the middle the lower one: a value that was measured."""
    v = v.ravel() if axis is None else v
    axis = axis or 0
    middle = (v.shape[axis] - 1) // 2
    return np.partition(v, middle, axis=axis).take(middle, axis=axis)


def running_median(v: np.ndarray, half: int) -> np.ndarray:
    """Medians `(T)` of `v (T)` over frames t - half to t + half, mirrored at the ends; half < T."""
    windows = sliding(np.pad(v, half, mode="reflect"), 2 * half + 1)
    return np.partition(windows, half, axis=-1)[:, half]


def sliding(v: Array, size: int) -> Array:
    """Views `(..., T - size + 1, size)` of the windows along the last axis `(..., T)`."""
    if isinstance(v, np.ndarray):
        return np.lib.stride_tricks.sliding_window_view(v, size, axis=-1)
    return v.unfold(-1, size, 1)


def side_by_side(v: Array) -> Array:
    """The same numbers as they lie in memory one after another."""
    return np.ascontiguousarray(v) if isinstance(v, np.ndarray) else v.contiguous()


def lerp(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """From `a` to `b` by a share, exact at both ends."""
    return np.where(share < 0.5, a + share * (b - a), b - (b - a) * (1.0 - share))
