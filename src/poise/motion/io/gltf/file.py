"""glTF files: the GLB container, the JSON document and its buffers, none of it trusted."""

from __future__ import annotations

import base64
import binascii
import json
import struct
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from poise.errors import PoiseError
from poise.motion.io.text import CUT_OFF, MAX_FILE_BYTES, MAX_JSON_BYTES, check_file, shown

if TYPE_CHECKING:
    from pygltflib import GLTF2

MAGIC = b"glTF"
_JSON, _BIN = 0x4E4F534A, 0x004E4942
MAX_OBJECTS = 100_000
"""Documents with more nodes or accessors than this are refused."""
MAX_CHANNELS = 10_000
"""The same for the channels of one animation: up to three for each joint, and some more."""
MAX_ELEMENTS = 40_000_000
"""Files whose accessors ask for more elements than this, all together, are refused."""
MAX_EMBEDDED_BYTES = 4 * MAX_FILE_BYTES // 3 + 64
"""Longer `data:` addresses cannot hold a buffer of the allowed size."""

# Motion needs these parts of a document; the others (meshes, images) are left aside unread.
_PARTS = ("nodes", "skins", "scenes", "animations", "accessors", "bufferViews", "buffers")
_DATA_URI = "data:"


@dataclass
class GltfFile:
    """A parsed document with its buffers, which are fetched when they are first needed.

    doc: pygltflib's dataclasses of `_PARTS`. uris: each buffer's address, None for the GLB's own.
    blob: the GLB's binary chunk.
    """

    path: Path
    doc: GLTF2
    uris: list[str | None]
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
        length = self.doc.buffers[index].byteLength
        uri = self.uris[index]
        if type(length) is not int or not 0 < length <= MAX_FILE_BYTES:
            raise PoiseError(f"buffer {index} states a length of {shown(str(length))} bytes", self.path)
        if uri is None:
            if index != 0 or self.blob is None:
                raise PoiseError(f"buffer {index} has neither an address nor a GLB chunk", self.path)
            data = self.blob
        elif uri.startswith(_DATA_URI):
            data = _embedded(uri, index, self.path)
        else:
            data = _beside(uri, index, self.path).read_bytes()
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
    check_file(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PoiseError(f"the file cannot be read ({error.strerror})", path) from None
    text, blob = _chunks(data, path) if data[:4] == MAGIC else (data, None)
    if len(text) > MAX_JSON_BYTES:
        raise PoiseError(f"the JSON has {len(text) / 1e6:.0f} MB, more than Poise reads", path)
    content = _parse(text, path)
    _check_version(content, path)
    uris = _check_parts(content, path)
    return GltfFile(path, _typed(content, path), uris, blob)


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
        if at == 12 and kind != _JSON:
            raise PoiseError("the first chunk of the GLB is not JSON", path)
        found.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    return found[_JSON], found.get(_BIN)


def _parse(text: bytes, path: Path) -> dict[str, Any]:
    if text.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] != b"{":
        raise PoiseError("this is no glTF: it starts with neither 'glTF' nor '{'", path)
    try:
        content = json.loads(text.removeprefix(b"\xef\xbb\xbf").decode("utf-8"))
    except UnicodeDecodeError:
        raise PoiseError("the JSON is not UTF-8 text", path) from None
    except json.JSONDecodeError as error:
        raise PoiseError(
            f"the JSON is not valid ({error.msg}, line {error.lineno})", path, CUT_OFF
        ) from None
    except (RecursionError, ValueError):
        raise PoiseError("the JSON is not valid", path) from None
    if not isinstance(content, dict):
        raise PoiseError("the JSON holds no glTF document", path)
    return content


def _check_version(content: dict[str, Any], path: Path) -> None:
    asset = content.get("asset")
    version = asset.get("version") if isinstance(asset, dict) else None
    if not isinstance(version, str):
        raise PoiseError("the document states no glTF version (asset.version)", path)
    if not version.startswith("2."):
        raise PoiseError(f"this is glTF version {shown(version)}", path, "Export it as glTF 2.0")


def _check_parts(content: dict[str, Any], path: Path) -> list[str | None]:
    """Refuses parts that are no lists of objects; returns the buffers' addresses, taken out."""
    for part in _PARTS:
        items = content.setdefault(part, [])
        if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
            raise PoiseError(f"'{part}' is not a list of objects", path)
        if len(items) > MAX_OBJECTS:
            raise PoiseError(
                f"'{part}' has {len(items)} entries, more than the {MAX_OBJECTS} allowed", path
            )
    for i, animation in enumerate(content["animations"]):
        for part in ("channels", "samplers"):
            held = animation.setdefault(part, [])
            if not isinstance(held, list):
                raise PoiseError(f"the {part} of animation {i} are no list", path)
            if len(held) > MAX_CHANNELS:
                raise PoiseError(
                    f"animation {i} has {len(held)} {part}, more than the {MAX_CHANNELS} allowed", path
                )
    uris = [buffer.pop("uri", None) for buffer in content["buffers"]]
    for i, uri in enumerate(uris):
        if uri is not None and not isinstance(uri, str):
            raise PoiseError(f"the address of buffer {i} is no text", path)
    return uris


def _typed(content: dict[str, Any], path: Path) -> GLTF2:
    """The parts as pygltflib's dataclasses, filled here: its own decoder takes 0.5 ms per object."""
    import pygltflib as gl

    inner: dict[type, dict[str, type]] = {
        gl.Accessor: {"sparse": gl.Sparse},
        gl.Sparse: {"indices": gl.AccessorSparseIndices, "values": gl.AccessorSparseValues},
        gl.Animation: {"channels": gl.AnimationChannel, "samplers": gl.AnimationSampler},
        gl.AnimationChannel: {"target": gl.AnimationChannelTarget},
    }
    kinds: dict[str, type] = {
        "nodes": gl.Node,
        "skins": gl.Skin,
        "scenes": gl.Scene,
        "animations": gl.Animation,
        "accessors": gl.Accessor,
        "bufferViews": gl.BufferView,
        "buffers": gl.Buffer,
    }
    known = {kind: {f.name for f in fields(kind)} for kind in (*kinds.values(), *_values(inner))}

    def built(kind: type, value: Any, what: str) -> Any:
        if not isinstance(value, dict):
            raise PoiseError(f"{what} is no object, as glTF demands", path)
        out = kind(**{key: v for key, v in value.items() if key in known[kind]})
        for key, part in inner.get(kind, {}).items():
            held = value.get(key)
            if isinstance(held, list):
                setattr(out, key, [built(part, v, f"an entry of '{key}'") for v in held])
            elif held is not None:
                setattr(out, key, built(part, held, f"'{key}'"))
        return out

    doc = gl.GLTF2()
    for part in _PARTS:
        setattr(doc, part, [built(kinds[part], v, f"an entry of '{part}'") for v in content[part]])
    return doc


def _values(inner: dict[type, dict[str, type]]) -> list[type]:
    return [kind for parts in inner.values() for kind in parts.values()]


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
        inside = target.is_relative_to(folder)
    except (OSError, ValueError, RuntimeError):
        raise PoiseError(f"the address of buffer {index} names no file", path) from None
    if not inside:
        raise PoiseError(
            f"buffer {index} names {shown(name)}, which lies outside the file's folder",
            path,
            "Put the buffer beside the file",
        )
    if not target.exists():
        raise PoiseError(
            f"its buffer file {shown(name)} is missing", path, "Put the buffer beside the file"
        )
    check_file(target)
    return target
