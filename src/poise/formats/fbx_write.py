"""Clips as binary FBX 7.4: a skeleton of limb nodes, and its curves."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from poise.formats.raw import quats_from_z_up, vectors_from_z_up
from poise.formats.text import write_whole
from poise.motion.clip import Clip
from poise.version import __version__

#: Ticks of a second; centimetres of a metre; the version of the format.
TICKS, CM, VERSION = 46_186_158_000, 100.0, 7400
_MAGIC = b"Kaydara FBX Binary  \x00\x1a\x00"
#: The end of a file: marks that readers look for.
_FOOT = (
    bytes.fromhex("fabcab09d0c8d466b1769d836eb5e22d"),
    bytes.fromhex("f85a8c6adef5d97eece90ce3758f290b"),
)
#: Of keys: linear between two.
_LINEAR = 0x4 | 0x100
_AXES = ("X", "Y", "Z")


@dataclass(frozen=True)
class _Node:
    """A record: its name, values and the records in it."""

    name: str
    values: tuple[Any, ...] = ()
    inside: tuple[_Node, ...] = ()


def write_fbx(clip: Clip, path: str | Path) -> None:
    """Writes a clip as binary FBX, in centimetres, Y up, with linear keys at the clip's own frames.

    Joints are limb nodes that stand in the clip's rest pose with every rotation at zero; rotations are
    Euler angles XYZ, continuous. Joints other than the root keep their places, as in a clip. Bone tips
    are not written, since a reader would take them for joints.

    Raises:
        PoiseError: the folder is missing or cannot be written.
    """
    skeleton = clip.skeleton
    offsets = vectors_from_z_up(skeleton.offsets, "Y") * CM
    root = vectors_from_z_up(clip.root_pos, "Y") * CM
    turns = _angles(quats_from_z_up(clip.rot, "Y"))
    times = np.round(np.arange(clip.frames) * (TICKS / clip.fps)).astype(np.int64)
    objects: list[_Node] = []
    links: list[tuple[str, np.int64, np.int64, str]] = []
    stack, layer = np.int64(1), np.int64(2)
    objects.append(
        _Node(
            "AnimationStack",
            (stack, _named("Take 001", "AnimStack"), ""),
            (
                _Node(
                    "Properties70",
                    inside=(
                        *(
                            _property(name, "KTime", "Time", "", time)
                            for kind in ("Local", "Reference")
                            for name, time in ((f"{kind}Start", times[0]), (f"{kind}Stop", times[-1]))
                        ),
                    ),
                ),
            ),
        )
    )
    objects.append(_Node("AnimationLayer", (layer, _named("BaseLayer", "AnimLayer"), "")))
    links.append(("OO", layer, stack, ""))
    for j, name in enumerate(skeleton.names):
        model, limb = np.int64(1000 + 10 * j), np.int64(1001 + 10 * j)
        place = root[0] if j == 0 else offsets[j]
        objects += [_limb(limb, name), _model(model, name, place, turns[0, j])]
        parent = skeleton.parents[j]
        links += [
            ("OO", limb, model, ""),
            ("OO", model, np.int64(0 if parent < 0 else 1000 + 10 * parent), ""),
        ]
        moving = [("R", "Lcl Rotation", turns[:, j])]
        if j == 0:
            moving.append(("T", "Lcl Translation", root))
        for k, (letter, what, values) in enumerate(moving):
            number = np.int64(1_000_000 + 100 * j + 10 * k)
            defaults = tuple(
                _property(f"d|{a}", "Number", "", "A", float(v))
                for a, v in zip(_AXES, values[0], strict=True)
            )
            made = (_Node("Properties70", inside=defaults),)
            objects.append(
                _Node("AnimationCurveNode", (number, _named(letter, "AnimCurveNode"), ""), made)
            )
            links += [("OO", number, layer, ""), ("OP", number, model, what)]
            for a, axis in enumerate(_AXES):
                objects.append(_curve(number + np.int64(1 + a), times, values[:, a]))
                links.append(("OP", number + np.int64(1 + a), number, f"d|{axis}"))
    top = (
        _header(),
        *_settings(clip.fps, times[-1]),
        _definitions(objects),
        _Node("Objects", inside=tuple(objects)),
        _Node(
            "Connections",
            inside=tuple(
                _Node("C", (kind, a, b, *((what,) if what else ()))) for kind, a, b, what in links
            ),
        ),
        _Node("Takes", inside=(_Node("Current", ("Take 001",)),)),
    )
    write_whole(Path(path), _file(top))


def _angles(quats: np.ndarray) -> np.ndarray:
    """`(T, J, 3)` degrees of rotations wxyz: about X, then Y, then Z of the parent; of two ways to say a
    turn the one that is nearer to the frame before."""
    frames, joints = quats.shape[:2]
    # SciPy is imported where a file is written: reading one needs none of it.
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(quats[..., (1, 2, 3, 0)].reshape(-1, 4))
    # A joint straight up or down leaves one angle free.
    out = np.degrees(turn.as_euler("xyz", suppress_warnings=True)).reshape(frames, joints, 3)
    other = np.stack((out[..., 0] + 180.0, 180.0 - out[..., 1], out[..., 2] + 180.0), -1)
    for t in range(1, frames):
        near = [a + 360.0 * np.round((out[t - 1] - a) / 360.0) for a in (out[t], other[t])]
        far = [np.abs(a - out[t - 1]).sum(-1, keepdims=True) for a in near]
        out[t] = np.where(far[0] <= far[1], near[0], near[1])
    return out


def _named(name: str, kind: str) -> str:
    return f"{name}\x00\x01{kind}"


def _property(name: str, kind: str, label: str, flags: str, *values: Any) -> _Node:
    return _Node("P", (name, kind, label, flags, *values))


def _limb(number: np.int64, name: str) -> _Node:
    inside = (_Node("TypeFlags", ("Skeleton",)),)
    return _Node("NodeAttribute", (number, _named(name, "NodeAttribute"), "LimbNode"), inside)


def _model(number: np.int64, name: str, place: np.ndarray, turn: np.ndarray) -> _Node:
    rows = (
        _property("RotationActive", "bool", "", "", 1),
        _property("InheritType", "enum", "", "", 1),
        _property("Lcl Translation", "Lcl Translation", "", "A", *map(float, place)),
        _property("Lcl Rotation", "Lcl Rotation", "", "A", *map(float, turn)),
        _property("Lcl Scaling", "Lcl Scaling", "", "A", 1.0, 1.0, 1.0),
    )
    inside = (_Node("Version", (232,)), _Node("Properties70", inside=rows))
    return _Node("Model", (number, _named(name, "Model"), "LimbNode"), inside)


def _curve(number: np.int64, times: np.ndarray, values: np.ndarray) -> _Node:
    count = len(times)
    inside = (
        _Node("Default", (float(values[0]),)),
        _Node("KeyVer", (4009,)),
        _Node("KeyTime", (times,)),
        _Node("KeyValueFloat", (values.astype(np.float32),)),
        _Node("KeyAttrFlags", (np.array([_LINEAR], np.int32),)),
        _Node("KeyAttrDataFloat", (np.zeros(4, np.float32),)),
        _Node("KeyAttrRefCount", (np.array([count], np.int32),)),
    )
    return _Node("AnimationCurve", (number, _named("", "AnimCurve"), ""), inside)


def _header() -> _Node:
    return _Node(
        "FBXHeaderExtension",
        inside=(
            _Node("FBXHeaderVersion", (1003,)),
            _Node("FBXVersion", (VERSION,)),
            _Node("Creator", (f"Poise {__version__}",)),
        ),
    )


def _settings(fps: float, stop: np.int64) -> tuple[_Node, ...]:
    """Y up, right-handed, centimetres, the frame rate; and what a document needs."""
    rows = [
        _property(name, "int", "Integer", "", value)
        for name, value in (
            ("UpAxis", 1),
            ("UpAxisSign", 1),
            ("FrontAxis", 2),
            ("FrontAxisSign", 1),
            ("CoordAxis", 0),
            ("CoordAxisSign", 1),
            ("OriginalUpAxis", 1),
            ("OriginalUpAxisSign", 1),
        )
    ]
    rows += [
        _property("UnitScaleFactor", "double", "Number", "", 1.0),
        _property("OriginalUnitScaleFactor", "double", "Number", "", 1.0),
        # A mode of its own, whose rate is stated.
        _property("TimeMode", "enum", "", "", 14),
        _property("TimeSpanStart", "KTime", "Time", "", np.int64(0)),
        _property("TimeSpanStop", "KTime", "Time", "", stop),
        _property("CustomFrameRate", "double", "Number", "", float(fps)),
    ]
    document = _Node("Document", (np.int64(10), "", "Scene"), (_Node("RootNode", (np.int64(0),)),))
    return (
        _Node(
            "GlobalSettings",
            inside=(_Node("Version", (1000,)), _Node("Properties70", inside=tuple(rows))),
        ),
        _Node("Documents", inside=(_Node("Count", (1,)), document)),
        _Node("References"),
    )


def _definitions(objects: Sequence[_Node]) -> _Node:
    kinds = [o.name for o in objects]
    rows = [_Node("Version", (100,)), _Node("Count", (len(objects) + 1,))]
    rows.append(_Node("ObjectType", ("GlobalSettings",), (_Node("Count", (1,)),)))
    for kind in dict.fromkeys(kinds):
        rows.append(_Node("ObjectType", (kind,), (_Node("Count", (kinds.count(kind),)),)))
    return _Node("Definitions", inside=tuple(rows))


def _file(top: Sequence[_Node]) -> bytes:
    out = bytearray(_MAGIC + struct.pack("<I", VERSION))
    for node in top:
        out += _record(node, len(out))
    out += bytes(13)
    out += _FOOT[0] + bytes(4)
    out += bytes(-len(out) % 16 or 16)
    out += struct.pack("<I", VERSION) + bytes(120) + _FOOT[1]
    return bytes(out)


def _record(node: _Node, start: int) -> bytes:
    """A record that begins at a place of the file, with what is in it."""
    name, values = node.name.encode(), b"".join(map(_value, node.values))
    out = bytearray(13 + len(name)) + values
    for child in node.inside:
        out += _record(child, start + len(out))
    if node.inside or not node.values:
        out += bytes(13)
    head = struct.pack("<IIIB", start + len(out), len(node.values), len(values), len(name)) + name
    out[: len(head)] = head
    return bytes(out)


def _value(value: Any) -> bytes:
    if isinstance(value, np.ndarray):
        letter = {"int64": b"l", "float32": b"f", "int32": b"i"}[value.dtype.name]
        packed = zlib.compress(value.astype(value.dtype.newbyteorder("<")).tobytes(), 1)
        return letter + struct.pack("<III", len(value), 1, len(packed)) + packed
    if isinstance(value, str):
        words = value.encode("utf-8")
        return b"S" + struct.pack("<I", len(words)) + words
    if isinstance(value, float):
        return b"D" + struct.pack("<d", value)
    # Numbers of objects and times are wide.
    wide = isinstance(value, np.integer)
    return b"L" + struct.pack("<q", value) if wide else b"I" + struct.pack("<i", value)
