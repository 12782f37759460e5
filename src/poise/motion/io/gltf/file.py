"""glTF files: the GLB container, the JSON document and its buffers, none of it trusted."""

from __future__ import annotations

import base64
import binascii
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from poise.errors import PoiseError
from poise.motion.io.text import CUT_OFF, MAX_FILE_BYTES, json_object, read_binary, shown

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
            )

    def buffer(self, index: int) -> bytes:
        """The bytes of buffer `index`, exactly as many as the document states."""
        if index not in self._buffers:
            self._buffers[index] = self._load(index)
        return self._buffers[index]

    def _load(self, index: int) -> bytes:
        length, uri = (self.doc["buffers"][index].get(key) for key in ("byteLength", "uri"))
        if type(length) is not int or not 0 < length <= MAX_FILE_BYTES:
            raise PoiseError(f"buffer {index} states a length of {shown(length)} bytes", self.path)
        if uri is None:
            if index != 0 or self.blob is None:
                raise PoiseError(f"buffer {index} has neither an address nor a GLB chunk", self.path)
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
        raise PoiseError("this is no glTF: it starts with neither 'glTF' nor '{'", path)
    doc = json_object(text, path)
    _check_version(doc, path)
    _check_parts(doc, path)
    return GltfFile(path, doc, blob)


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a GLB container."""
    if len(data) < 20:
        raise PoiseError(f"a GLB file needs at least 20 bytes, this has {len(data)}", path, CUT_OFF)
    version, total = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise PoiseError(f"this is GLB version {version}", path, "Export it as glTF 2.0")
    if total > len(data):
        raise PoiseError(
            f"the GLB header states {total} bytes, but {len(data)} are there", path, CUT_OFF
        )
    found: dict[int, bytes] = {}
    at = 12
    while at + 8 <= total:
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > total:
            left = total - at - 8
            raise PoiseError(
                f"the chunk at byte {at} states {length} bytes, but {left} are left", path, CUT_OFF
            )
        if at == 12 and kind != JSON_CHUNK:
            raise PoiseError("the first chunk of the GLB is not JSON", path)
        found.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    if JSON_CHUNK not in found:
        raise PoiseError(f"the GLB header states {total} bytes, which hold no JSON", path, CUT_OFF)
    return found[JSON_CHUNK], found.get(BIN_CHUNK)


def _check_version(content: dict[str, Any], path: Path) -> None:
    asset = content.get("asset")
    version = asset.get("version") if isinstance(asset, dict) else None
    if not isinstance(version, str):
        raise PoiseError("the document states no glTF version (asset.version)", path)
    if not version.startswith("2."):
        raise PoiseError(f"this is glTF version {shown(version)}", path, "Export it as glTF 2.0")


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
            raise PoiseError(f"the address of buffer {i} is no text", path)


def _check_list(holder: dict[str, Any], key: str, what: str, most: int, path: Path) -> None:
    items = holder.setdefault(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise PoiseError(f"{what} is not a list of objects", path)
    if len(items) > most:
        raise PoiseError(f"{what} has {len(items)} entries, more than the {most} allowed", path)


def _check_object(holder: dict[str, Any], key: str, path: Path) -> dict[str, Any]:
    """The object under a key, empty where there is none."""
    value = holder.get(key)
    if not isinstance(value, dict | None):
        raise PoiseError(f"'{key}' is no object, as glTF demands", path)
    return value or {}


def _embedded(uri: str, index: int, path: Path) -> bytes:
    head, comma, body = uri.partition(",")
    if not comma or not head.endswith(";base64") or len(body) > MAX_EMBEDDED_BYTES:
        raise PoiseError(f"the embedded buffer {index} is not base64 of a usable size", path)
    try:
        return base64.b64decode(body, validate=True)
    except (binascii.Error, ValueError):
        raise PoiseError(f"the embedded buffer {index} is not valid base64", path, CUT_OFF) from None


def _beside(uri: str, index: int, path: Path) -> Path:
    """The file an address names; it must lie in the document's own folder or below it."""
    name = unquote(uri)
    if "://" in name or name.split("/")[0].endswith(":"):
        raise PoiseError(
            f"buffer {index} lies at {shown(name)}, and Poise fetches nothing from elsewhere",
            path,
            "Save it with its buffers embedded (.glb)",
        )
    folder = path.parent.resolve()
    try:
        target = (folder / name.replace("\\", "/")).resolve()
        inside, there = target.is_relative_to(folder), target.is_file()
    except (OSError, ValueError, RuntimeError):
        raise PoiseError(f"the address of buffer {index} names no file", path) from None
    if not inside:
        raise PoiseError(
            f"buffer {index} names {shown(name)}, which lies outside the file's folder",
            path,
            "Put the buffer beside the file",
        )
    if not there:
        raise PoiseError(
            f"its buffer file {shown(name)} is missing", path, "Put the buffer beside the file"
        )
    return target
