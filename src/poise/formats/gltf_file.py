"""glTF files: the GLB container, the JSON document, its buffers and accessors, none of it trusted."""

from __future__ import annotations

import base64
import binascii
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from poise.errors import PoiseError
from poise.formats.text import CUT_OFF, MAX_FILE_BYTES, json_object, read_binary, shown

MAGIC = b"glTF"
JSON_CHUNK, BIN_CHUNK = 0x4E4F534A, 0x004E4942
MAX_OBJECTS = 100_000
"""Documents with more nodes or accessors than this are refused."""
MAX_CHANNELS = 10_000
"""The same for the channels of one animation: up to three for each joint, and some more."""
MAX_ELEMENTS = 40_000_000
"""Files with accessors that ask for more elements than this, all together, are refused."""
MAX_EMBEDDED_BYTES = 4 * MAX_FILE_BYTES // 3 + 64
"""Longer `data:` addresses cannot hold a buffer of the allowed size."""

# Motion needs these parts of a document; the others (meshes, images) are left aside unread.
_PARTS = ("nodes", "skins", "scenes", "animations", "accessors", "bufferViews", "buffers")
_DATA_URI = "data:"


@dataclass
class GltfFile:
    """A parsed document with its buffers, which are fetched when they are first needed.

    doc: the JSON; its `_PARTS` are lists of objects for certain; what these hold is not checked.
    blob: the GLB's binary chunk.
    """

    path: Path
    doc: dict[str, Any]
    blob: bytes | None
    _buffers: dict[int, bytes] = field(default_factory=dict)
    _read: int = 0

    def spend(self, elements: int) -> None:
        """Counts values that are read, so that no small file can ask for endless work."""
        self._read += elements
        if self._read > MAX_ELEMENTS:
            raise PoiseError(
                f"its animation has more than {MAX_ELEMENTS} keys",
                self.path,
                "Cut it into shorter clips",
                code="clip-too-long",
            )

    def buffer(self, index: int) -> bytes:
        """The bytes of buffer `index`, exactly as many as the document states."""
        if index not in self._buffers:
            self._buffers[index] = self._load(index)
        return self._buffers[index]

    def _load(self, index: int) -> bytes:
        length, uri = (self.doc["buffers"][index].get(key) for key in ("byteLength", "uri"))
        if type(length) is not int or not 0 < length <= MAX_FILE_BYTES:
            raise PoiseError(
                f"buffer {index} states a length of {shown(length)} bytes",
                self.path,
                code="number-unusable",
            )
        if uri is None:
            if index != 0 or self.blob is None:
                raise PoiseError(
                    f"buffer {index} has neither an address nor a GLB chunk",
                    self.path,
                    code="data-missing",
                )
            data = self.blob
        elif uri.startswith(_DATA_URI):
            data = _embedded(uri, index, self.path)
        else:
            data = read_binary(_beside(uri, index, self.path))
        if len(data) < length:
            raise PoiseError(
                f"buffer {index} has {len(data)} bytes, but the document states {length}",
                self.path,
                CUT_OFF,
                code="file-cut-off",
            )
        return data[:length]


def load_gltf(path: Path) -> GltfFile:
    """Reads a .glb or .gltf file's document; buffers follow when they are asked for.

    Raises:
        PoiseError: bad container, broken JSON, an unknown version, too many objects.
    """
    data = read_binary(path)
    text, blob = _chunks(data, path) if data[:4] == MAGIC else (data, None)
    if text.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] != b"{":
        raise PoiseError(
            "this is no glTF: it starts with neither 'glTF' nor '{'", path, code="wrong-format"
        )
    doc = json_object(text, path)
    _check_version(doc, path)
    _check_parts(doc, path)
    return GltfFile(path, doc, blob)


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a GLB container."""
    if len(data) < 20:
        raise PoiseError(
            f"a GLB file needs at least 20 bytes, this has {len(data)}",
            path,
            CUT_OFF,
            code="file-cut-off",
        )
    version, total = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise PoiseError(
            f"this is GLB version {version}", path, "Export it as glTF 2.0", code="version-unsupported"
        )
    if total > len(data):
        raise PoiseError(
            f"the GLB header states {total} bytes, but {len(data)} are there",
            path,
            CUT_OFF,
            code="file-cut-off",
        )
    found: dict[int, bytes] = {}
    at = 12
    while at + 8 <= total:
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > total:
            left = total - at - 8
            raise PoiseError(
                f"the chunk at byte {at} states {length} bytes, but {left} are left",
                path,
                CUT_OFF,
                code="file-cut-off",
            )
        if at == 12 and kind != JSON_CHUNK:
            raise PoiseError("the first chunk of the GLB is not JSON", path, code="bad-json")
        found.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    if JSON_CHUNK not in found:
        raise PoiseError(
            f"the GLB header states {total} bytes, which hold no JSON", path, CUT_OFF, code="bad-json"
        )
    return found[JSON_CHUNK], found.get(BIN_CHUNK)


def _check_version(content: dict[str, Any], path: Path) -> None:
    asset = content.get("asset")
    version = asset.get("version") if isinstance(asset, dict) else None
    if not isinstance(version, str):
        raise PoiseError(
            "the document states no glTF version (asset.version)", path, code="part-missing"
        )
    if not version.startswith("2."):
        raise PoiseError(
            f"this is glTF version {shown(version)}",
            path,
            "Export it as glTF 2.0",
            code="version-unsupported",
        )


def _check_parts(content: dict[str, Any], path: Path) -> None:
    """Refuses parts that are no lists of objects or hold too many; absent ones are empty."""
    for part in _PARTS:
        _check_list(content, part, f"'{part}'", MAX_OBJECTS, path)
    for i, animation in enumerate(content["animations"]):
        for part in ("channels", "samplers"):
            _check_list(animation, part, f"'{part}' of animation {i}", MAX_CHANNELS, path)
        for channel in animation["channels"]:
            _check_object(channel, "target", path)
    for accessor in content["accessors"]:
        sparse = _check_object(accessor, "sparse", path)
        for part in ("indices", "values"):
            _check_object(sparse, part, path)
    for i, buffer in enumerate(content["buffers"]):
        if not isinstance(buffer.get("uri"), str | None):
            raise PoiseError(f"the address of buffer {i} is no text", path, code="wrong-type")


def _check_list(holder: dict[str, Any], key: str, what: str, most: int, path: Path) -> None:
    items = holder.setdefault(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise PoiseError(f"{what} is not a list of objects", path, code="not-a-list")
    if len(items) > most:
        raise PoiseError(
            f"{what} has {len(items)} entries, more than the {most} allowed", path, code="over-limit"
        )


def _check_object(holder: dict[str, Any], key: str, path: Path) -> dict[str, Any]:
    """The object under a key, empty where there is none."""
    value = holder.get(key)
    if not isinstance(value, dict | None):
        raise PoiseError(f"'{key}' is no object, as glTF demands", path, code="not-an-object")
    return value or {}


def _embedded(uri: str, index: int, path: Path) -> bytes:
    head, comma, body = uri.partition(",")
    if not comma or not head.endswith(";base64") or len(body) > MAX_EMBEDDED_BYTES:
        raise PoiseError(
            f"the embedded buffer {index} is not base64 of a usable size", path, code="bad-base64"
        )
    try:
        return base64.b64decode(body, validate=True)
    except (binascii.Error, ValueError):
        raise PoiseError(
            f"the embedded buffer {index} is not valid base64", path, CUT_OFF, code="bad-base64"
        ) from None


def _beside(uri: str, index: int, path: Path) -> Path:
    """The file an address names; it must lie in the document's own folder or below it."""
    name = unquote(uri)
    if "://" in name or name.split("/")[0].endswith(":"):
        raise PoiseError(
            f"buffer {index} lies at {shown(name)}, and Poise fetches nothing from elsewhere",
            path,
            "Save it with its buffers embedded (.glb)",
            code="outside-folder",
        )
    folder = path.parent.resolve()
    try:
        target = (folder / name.replace("\\", "/")).resolve()
        inside, there = target.is_relative_to(folder), target.is_file()
    except (OSError, ValueError, RuntimeError):
        raise PoiseError(
            f"the address of buffer {index} names no file", path, code="address-malformed"
        ) from None
    if not inside:
        raise PoiseError(
            f"buffer {index} names {shown(name)}, which lies outside the file's folder",
            path,
            "Put the buffer beside the file",
            code="outside-folder",
        )
    if not there:
        raise PoiseError(
            f"its buffer file {shown(name)} is missing",
            path,
            "Put the buffer beside the file",
            code="file-missing",
        )
    return target


_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_PACKED = ("EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_draco_mesh_compression")


def index_of(value: object, items: list[Any], what: str, file: GltfFile) -> int:
    """A checked index into one of the document's lists; `what` names the reference."""
    if type(value) is not int or not 0 <= value < len(items):
        raise PoiseError(
            f"{what} refers to entry {shown(value)}, but there are {len(items)}",
            file.path,
            code="index-outside",
        )
    return value


def _whole(value: object, what: str, file: GltfFile, low: int = 0) -> int:
    """A checked whole number that is not absurdly large; an absent one is 0."""
    value = 0 if value is None else value
    if type(value) is not int or not low <= value < 1 << 40:
        raise PoiseError(
            f"{what} is {shown(value)}, no usable number", file.path, code="number-unusable"
        )
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
        raise PoiseError(
            f"{name} must be of type {kind}, got {shown(stated)}", file.path, code="wrong-type"
        )
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
        raise PoiseError(f"{name} has no data", file.path, code="data-missing")
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
        raise PoiseError(
            f"{name} has the unknown component type {shown(component)}", file.path, code="wrong-type"
        )
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
            code="compressed",
        )
    data = file.buffer(index_of(v.get("buffer"), file.doc["buffers"], f"the view of {name}", file))
    start = _whole(v.get("byteOffset"), "a view's offset", file)
    length = _whole(v.get("byteLength"), "a view's length", file)
    if start + length > len(data):
        raise PoiseError(
            f"the view of {name} ends at byte {start + length} of a buffer of {len(data)}",
            file.path,
            code="data-out-of-bounds",
        )
    size = width * dtype.itemsize
    stride = _whole(v.get("byteStride"), "a view's stride", file) or size
    at = _whole(part.get("byteOffset"), f"the offset of {name}", file)
    if stride < size or at + stride * (count - 1) + size > length:
        raise PoiseError(
            f"{name} needs {at + stride * (count - 1) + size} bytes of a view of {length}",
            file.path,
            code="data-out-of-bounds",
        )
    return np.ndarray((count, width), dtype, data, start + at, (stride, dtype.itemsize))


def _with_sparse(file: GltfFile, sparse: dict[str, Any], dense: np.ndarray, name: str) -> np.ndarray:
    """The elements with those replaced that the sparse part lists."""
    indices, values = sparse.get("indices"), sparse.get("values")
    if indices is None or values is None:
        raise PoiseError(f"the sparse part of {name} is incomplete", file.path, code="data-missing")
    count = _whole(sparse.get("count"), f"the sparse count of {name}", file, 1)
    if count > len(dense):
        raise PoiseError(
            f"{name} replaces {count} of {len(dense)} elements", file.path, code="data-out-of-bounds"
        )
    kind = _dtype(indices.get("componentType"), name, file)
    if kind.kind != "u":
        raise PoiseError(
            f"the sparse indices of {name} are not unsigned integers", file.path, code="wrong-type"
        )
    where = _strided(file, indices, count, 1, kind, name)[:, 0]
    if int(where.max()) >= len(dense):
        raise PoiseError(
            f"{name} replaces element {int(where.max())} of {len(dense)}",
            file.path,
            code="data-out-of-bounds",
        )
    out = dense.copy()
    out[where] = _strided(file, values, count, out.shape[1], out.dtype, name)
    return out
