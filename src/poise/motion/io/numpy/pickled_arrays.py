"""What pickles of NumPy arrays name, made here from their bytes: no code of NumPy's or theirs runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from poise.motion.io.numpy.arrays import no_text

_KINDS = "biufcSU?"


@dataclass(eq=False)
class Dtype:
    """An array's element type while it is read."""

    code: str
    order: str = "="


@dataclass(eq=False)
class Array:
    """An array or a scalar while it is read."""

    value: Any = None


def checked(kind: type | tuple[type, ...], value: Any) -> Any:
    """The value if it is of the wanted kind."""
    if not isinstance(value, kind):
        raise ValueError(f"a {type(value).__name__} stands in the wrong place")
    return value


def text(value: Any) -> str:
    """A text that Python 2 wrote as bytes."""
    return value.decode("ascii") if isinstance(value, bytes) else checked(str, value)


def array_of(shape: Any, dtype: Dtype, fortran: Any, data: Any) -> Any:
    """The array of a pickled state; one of objects becomes a list, or its only item."""
    shape = tuple(int(n) for n in checked(tuple, shape))
    count = math.prod(shape)
    if min(shape, default=0) < 0:
        raise ValueError("an array has a negative length")
    if checked(Dtype, dtype).code.startswith("O"):
        items = checked(list, data)
        if len(items) != count:
            raise ValueError("an array has the wrong number of items")
        return items if shape else items[0]
    kind = _numeric(dtype)
    # Python 2 wrote bytes as text.
    raw = data.encode("latin-1") if isinstance(data, str) else bytes(checked((bytes, bytearray), data))
    if len(raw) != count * kind.itemsize:
        raise ValueError(f"an array of shape {shape} has {len(raw)} bytes")
    order = "F" if fortran else "C"
    flat = np.frombuffer(raw, kind)
    if no_text(flat):
        raise ValueError("characters that do not exist")
    return flat.reshape(shape, order=order)


def _numeric(dtype: Dtype) -> np.dtype[Any]:
    code = text(dtype.code)
    if code[:1] not in _KINDS or not (code[1:] == "" or code[1:].isdecimal()) or len(code) > 9:
        raise ValueError(f"arrays of type {code[:12]} are no plain data")
    kind = np.dtype(code)
    return kind if dtype.order == "|" else kind.newbyteorder(dtype.order)  # type: ignore[arg-type]


def _made_dtype(code: Any, *more: Any) -> Dtype:
    return Dtype(text(code))


def _made_array(*args: Any) -> Array:
    return Array()


def _made_scalar(dtype: Any, data: Any = b"") -> Array:
    return Array(array_of((), dtype, False, data)[()])


def _made_from_buffer(data: Any, dtype: Any, shape: Any, order: Any = "C") -> Array:
    return Array(array_of(tuple(shape), dtype, order == "F", data))


def _made_bytes(text: Any, coding: Any = "latin1") -> bytes:
    return checked(str, text).encode("latin-1")


def _made_nothing() -> bytes:
    """What old protocols write for empty bytes."""
    return b""


def _made_dict(pairs: Any = ()) -> dict[Any, Any]:
    return plain_dict([pair[0] for pair in pairs], [pair[1] for pair in pairs])


def plain_dict(keys: list[Any], values: list[Any]) -> dict[Any, Any]:
    """A dict with keys of text, bytes or whole numbers: others could take for ever to hash."""
    if not all(isinstance(key, str | int | bytes) for key in keys):
        raise ValueError("a key is no text")
    return dict(zip(keys, values, strict=True))


CALLS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _made_dtype,
    "numpy.core.multiarray._reconstruct": _made_array,
    "numpy.core.multiarray.scalar": _made_scalar,
    "numpy.core.numeric._frombuffer": _made_from_buffer,
    "_codecs.encode": _made_bytes,
    "__builtin__.bytes": _made_nothing,
    "collections.OrderedDict": _made_dict,
}
"""What a pickle may name and have made, under the names that NumPy gives."""
