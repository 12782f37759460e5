"""Small glTF documents made by hand, without the library that Poise reads and writes them with."""

from __future__ import annotations

import base64
import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

HALF = math.sqrt(0.5)
QUARTER_X = (-HALF, 0.0, 0.0, HALF)
"""xyzw: minus 90 degrees about X, which brings a Z-up armature upright in a Y-up file."""


class Gltf:
    """A document in the making: `doc` is its JSON, `data` its one buffer."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.doc: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            "nodes": [],
            "accessors": [],
            "bufferViews": [],
            "animations": [],
        }

    def node(self, name: str | None, parent: int | None = None, **fields: object) -> int:
        index = len(self.doc["nodes"])
        self.doc["nodes"].append({**({} if name is None else {"name": name}), **fields})
        where = self.doc["scenes"][0]["nodes"] if parent is None else self.doc["nodes"][parent]
        if parent is None:
            where.append(index)
        else:
            where.setdefault("children", []).append(index)
        return index

    def view(self, data: bytes, **fields: object) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **fields}
        self.doc["bufferViews"].append(view)
        self.data += data
        return len(self.doc["bufferViews"]) - 1

    def accessor(self, values: object, dtype: str = "<f4", **fields: object) -> int:
        array = np.asarray(values, dtype=dtype)
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        component = {"<i1": 5120, "<u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}[dtype]
        self.doc["accessors"].append(
            {
                "bufferView": self.view(array.tobytes()),
                "componentType": component,
                "count": len(array),
                "type": kind,
                **fields,
            }
        )
        return len(self.doc["accessors"]) - 1

    def animation(self, name: str | None = None) -> dict[str, Any]:
        made: dict[str, Any] = {
            "channels": [],
            "samplers": [],
            **({} if name is None else {"name": name}),
        }
        self.doc["animations"].append(made)
        return made

    def channel(
        self,
        animation: dict[str, Any],
        node: int,
        path: str,
        times: object,
        values: object,
        mode: str = "LINEAR",
        **fields: object,
    ) -> None:
        """`values` may be the index of an accessor that is already there."""
        output = values if isinstance(values, int) else self.accessor(values)
        sampler = {"input": self.accessor(times), "output": output, "interpolation": mode, **fields}
        animation["samplers"].append(sampler)
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})

    def glb(self) -> bytes:
        doc = {**self.doc, "buffers": [{"byteLength": len(self.data)}]}
        text = json.dumps(doc).encode()
        text += b" " * (-len(text) % 4)
        blob = bytes(self.data) + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(blob), 0x004E4942) + blob
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks

    def gltf(self, uri: str | None = None) -> str:
        """JSON with its buffer embedded, or at the address `uri`."""
        data = "data:application/octet-stream;base64," + base64.b64encode(bytes(self.data)).decode()
        buffer = {"byteLength": len(self.data), "uri": uri or data}
        return json.dumps({**self.doc, "buffers": [buffer]}, indent=1)


BONES = (
    ("Hips", None, (0.0, 0.9, 0.0)),
    ("Spine", "Hips", (0.0, 0.25, 0.0)),
    ("Head", "Spine", (0.0, 0.35, 0.0)),
    ("LeftLeg", "Hips", (0.1, 0.0, 0.0)),
    ("LeftFoot", "LeftLeg", (0.0, -0.85, 0.0)),
)


def turn(axis: str, degrees: float) -> tuple[float, float, float, float]:
    """A rotation as xyzw."""
    half = math.radians(degrees) / 2
    out = [0.0, 0.0, 0.0, math.cos(half)]
    out["xyz".index(axis)] = math.sin(half)
    return out[0], out[1], out[2], out[3]


def person(
    parent: int | None = None, file: Gltf | None = None, size: float = 1.0, skin: bool = True
) -> tuple[Gltf, dict[str, int]]:
    """Five joints in rest pose, `size` file units to a metre, perhaps below a node that is there."""
    made = file or Gltf()
    at: dict[str, int] = {}
    for name, up, place in BONES:
        translation = [size * x for x in place]
        at[name] = made.node(name, parent if up is None else at[up], translation=translation)
    if skin:
        made.doc["skins"] = [{"joints": list(at.values())}]
    return made, at


def walker(frames: int = 7, fps: float = 30.0, skin: bool = True) -> tuple[Gltf, dict[str, int]]:
    """A body that travels along Z and swings the leg about X."""
    file, at = person(skin=skin)
    animation = file.animation("walk")
    times = [k / fps for k in range(frames)]
    file.channel(
        animation, at["Hips"], "translation", times, [(0, 0.9, 0.05 * k) for k in range(frames)]
    )
    file.channel(
        animation, at["LeftLeg"], "rotation", times, [turn("x", 5.0 * k) for k in range(frames)]
    )
    return file, at


def put(folder: Path, name: str, file: Gltf) -> Path:
    path = folder / name
    if name.endswith(".glb"):
        path.write_bytes(file.glb())
    else:
        path.write_text(file.gltf())
    return path
