"""glTF accessors as arrays: bounds, strides, sparse values, normalised integers."""

from __future__ import annotations

from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.motion.io.gltf.file import GltfFile
from poise.motion.io.text import shown

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_PACKED = ("EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_draco_mesh_compression")


def index_of(value: object, items: list[Any], what: str, file: GltfFile) -> int:
    """A checked index into one of the document's lists; `what` names the reference."""
    if type(value) is not int or not 0 <= value < len(items):
        raise PoiseError(f"{what} refers to entry {shown(value)}, but there are {len(items)}", file.path)
    return value


def _whole(value: object, what: str, file: GltfFile, low: int = 0) -> int:
    """A checked whole number that is not absurdly large; an absent one is 0."""
    value = 0 if value is None else value
    if type(value) is not int or not low <= value < 1 << 40:
        raise PoiseError(f"{what} is {shown(value)}, no usable number", file.path)
    return value


def read_accessor(file: GltfFile, index: object, kind: str, what: str) -> np.ndarray:
    """`(count, width)` float64 elements of an accessor of type `kind`.

    Normalised integers become c / max, at least -1 (glTF 2.0, section 3.11). Values may be
    interleaved with others, and sparse ones replace those of the view or zeros.
    """
    accessors = file.doc["accessors"]
    i = index_of(index, accessors, what, file)
    accessor = accessors[i]
    name = f"accessor {i} ({what})"
    stated = accessor.get("type")
    if stated != kind:
        raise PoiseError(f"{name} must be of type {kind}, got {shown(stated)}", file.path)
    count = _whole(accessor.get("count"), f"the count of {name}", file, 1)
    file.spend(count)
    width = _WIDTHS[kind]
    dtype = _dtype(accessor.get("componentType"), name, file)
    sparse = accessor.get("sparse")
    if accessor.get("bufferView") is not None:
        out = _strided(file, accessor, count, width, dtype, name)
    elif sparse is not None:
        out = np.zeros((count, width), dtype)
    else:
        raise PoiseError(f"{name} has no data", file.path)
    if sparse is not None:
        out = _with_sparse(file, sparse, out, name)
    # Odd kinds of NaN are told as what they are where they are used.
    with np.errstate(invalid="ignore"):
        values = out.astype(np.float64)
    if accessor.get("normalized") and dtype.kind in "iu":
        values = np.maximum(values / np.iinfo(dtype).max, -1.0)
    return values


def _dtype(component: object, name: str, file: GltfFile) -> np.dtype:
    if type(component) is not int or component not in _DTYPES:
        raise PoiseError(f"{name} has the unknown component type {shown(component)}", file.path)
    return np.dtype(_DTYPES[component])


def _strided(
    file: GltfFile, part: dict[str, Any], count: int, width: int, dtype: np.dtype, name: str
) -> np.ndarray:
    """`(count, width)` elements where an accessor's `part` points, with its buffer view's stride."""
    views = file.doc["bufferViews"]
    v = views[index_of(part.get("bufferView"), views, name, file)]
    extensions = v.get("extensions")
    packed = next((e for e in _PACKED if isinstance(extensions, dict) and e in extensions), None)
    if packed is not None:
        raise PoiseError(
            f"the data of {name} are compressed with {packed}",
            file.path,
            "Export the file without compression",
        )
    data = file.buffer(index_of(v.get("buffer"), file.doc["buffers"], f"the view of {name}", file))
    start = _whole(v.get("byteOffset"), "a view's offset", file)
    length = _whole(v.get("byteLength"), "a view's length", file)
    if start + length > len(data):
        raise PoiseError(
            f"the view of {name} ends at byte {start + length} of a buffer of {len(data)}", file.path
        )
    size = width * dtype.itemsize
    stride = _whole(v.get("byteStride"), "a view's stride", file) or size
    at = _whole(part.get("byteOffset"), f"the offset of {name}", file)
    if stride < size or at + stride * (count - 1) + size > length:
        raise PoiseError(
            f"{name} needs {at + stride * (count - 1) + size} bytes of a view of {length}", file.path
        )
    return np.ndarray((count, width), dtype, data, start + at, (stride, dtype.itemsize))


def _with_sparse(file: GltfFile, sparse: dict[str, Any], dense: np.ndarray, name: str) -> np.ndarray:
    """The elements with those replaced that the sparse part lists."""
    indices, values = sparse.get("indices"), sparse.get("values")
    if indices is None or values is None:
        raise PoiseError(f"the sparse part of {name} is incomplete", file.path)
    count = _whole(sparse.get("count"), f"the sparse count of {name}", file, 1)
    if count > len(dense):
        raise PoiseError(f"{name} replaces {count} of {len(dense)} elements", file.path)
    kind = _dtype(indices.get("componentType"), name, file)
    if kind.kind != "u":
        raise PoiseError(f"the sparse indices of {name} are not unsigned integers", file.path)
    where = _strided(file, indices, count, 1, kind, name)[:, 0]
    if int(where.max()) >= len(dense):
        raise PoiseError(f"{name} replaces element {int(where.max())} of {len(dense)}", file.path)
    out = dense.copy()
    out[where] = _strided(file, values, count, out.shape[1], out.dtype, name)
    return out
