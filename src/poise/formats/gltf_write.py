"""Clips as glTF: the source's nodes, their motion, and a skinned figure to look at."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from poise.formats.figure import SceneBox, bone_figure, box_mesh
from poise.formats.gltf_file import BIN_CHUNK, JSON_CHUNK, MAGIC
from poise.formats.nodes import base_of, tips_from_z_up
from poise.formats.raw import quats_from_z_up, vectors_from_z_up
from poise.formats.root_joint import Restored, restored
from poise.formats.text import write_whole
from poise.motion.clip import Clip
from poise.motion.rotations import normalize, quat_conj, quat_mul, quat_to_matrix, unwrap_quats

_FLOAT, _UBYTE, _USHORT = 5126, 5121, 5123
_DTYPES = {_FLOAT: "<f4", _UBYTE: "<u1", _USHORT: "<u2"}
_ARRAY = 34962
_COLOUR = [0.85, 0.45, 0.15, 1.0]
_WOOD = [0.62, 0.58, 0.52, 1.0]
_IDENTITY = [1.0, 0.0, 0.0, 0.0]


@dataclass(frozen=True)
class _Plan:
    """The node tree to write, in the file's units and axes.

    above: `(name, place, turn wxyz, scale)` static nodes, outermost first. scale, place, rest:
    each joint's constant scale, local rest place and local rest rotation (wxyz). turns `(T, J, 4)`,
    paths: local channels; only joints in `paths` `(T, 3)` move against their parents.
    """

    above: list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]
    scale: np.ndarray
    place: np.ndarray
    rest: np.ndarray
    turns: np.ndarray
    paths: dict[int, np.ndarray]
    unit_m: float
    axis: str
    take: str


def write_gltf(clip: Clip, path: str | Path, boxes: Sequence[SceneBox] = ()) -> None:
    """Writes a clip as .glb, or as .gltf with its buffer embedded.

    A clip that came from glTF gets back its nodes above the root, scales, rest pose, unit and the
    name of its animation; any other is in metres. Always Y up. A skin binds a figure of slim
    octahedra to the joints, so that viewers show the motion at once. Keys stand at the clip's own
    frames; bone tips, the exact frame rate and `cyclic` are kept in `extras`. The figure hangs on the
    joint that travels, so that viewers, which know its bounds in one frame alone, do not lose it.

    Args:
        boxes: what stands beside the motion, each a node with a mesh.

    Raises:
        PoiseError: the folder is missing or cannot be written to.
    """
    path = Path(path)
    plan = _plan(clip)
    document, blob = _document(clip, plan, boxes)
    buffer: dict[str, Any] = {"byteLength": len(blob)}
    document["buffers"] = [buffer]
    if path.suffix.lower() == ".gltf":
        text = base64.b64encode(blob).decode("ascii")
        buffer["uri"] = f"data:application/octet-stream;base64,{text}"
        write_whole(path, json.dumps(document, indent=2) + "\n")
    else:
        write_whole(path, _glb(document, blob))


def _plan(clip: Clip) -> _Plan:
    skeleton, source = clip.skeleton, clip.skeleton.source
    kept = _kept(clip)
    unit, axis = (source.unit_m, source.up_axis) if kept else (1.0, "Y")
    count = len(skeleton)
    rot = quats_from_z_up(clip.rot, axis)
    root_pos = vectors_from_z_up(clip.root_pos, axis) / unit
    offsets = vectors_from_z_up(skeleton.offsets, axis) / unit
    above = [(n, np.array(p), np.array(q), np.array(s)) for n, p, q, s in kept.get("above", [])]
    scale = np.array(kept.get("scale", np.ones(count)))
    base = base_of([(p, q, s) for _, p, q, s in above])
    own = Restored({0: root_pos}, offsets)
    back = restored(skeleton, offsets, root_pos, rot) if kept else own
    paths, offsets = back.paths, back.offsets
    paths[0] = base.down(paths[0])
    rot[:, 0] = quat_mul(np.broadcast_to(quat_conj(base.turn), (len(rot), 4)), rot[:, 0])
    factor = np.full(count, base.below())
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            factor[j] = factor[parent] * scale[parent]
    place = offsets / factor[:, None]
    for j in paths:
        if j:
            paths[j] = paths[j] / factor[j]
            place[j] = paths[j][0]
    place[0] = kept.get("root", paths[0][0])
    return _Plan(
        above,
        scale,
        place,
        np.array(kept.get("rest", [_IDENTITY] * count)),
        unwrap_quats(normalize(rot)),
        paths,
        unit,
        axis,
        str(kept.get("take", clip.name)),
    )


def _kept(clip: Clip) -> dict[str, Any]:
    """What the reader remembered of the source's nodes; empty for a clip from another format."""
    source = clip.skeleton.source
    text = dict(source.extra).get("gltf") if source.format == "gltf" else None
    kept = json.loads(text) if text else {}
    fits = len(kept.get("rest", ())) == len(clip.skeleton) == len(kept.get("scale", ()))
    return kept if fits else {}


class _Document:
    """A glTF document and its one buffer, in which accessors stand aligned to four bytes."""

    def __init__(self) -> None:
        self.doc: dict[str, Any] = {"asset": {"version": "2.0", "generator": "Poise"}, "scene": 0}
        self.doc |= {"nodes": [], "accessors": [], "bufferViews": []}
        self.data = bytearray()

    def add(
        self,
        values: np.ndarray,
        kind: str,
        component: int = _FLOAT,
        target: int | None = None,
        bounds: bool = False,
    ) -> int:
        """Appends an accessor and returns its index; `bounds` states the smallest and largest."""
        array = np.ascontiguousarray(values, dtype=_DTYPES[component])
        if component == _FLOAT:
            # Without -0, so that files of the same motion are the same.
            array = array + np.float32(0)
        index = len(self.doc["accessors"])
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.doc["bufferViews"].append(view if target is None else {**view, "target": target})
        accessor = {"bufferView": index, "componentType": component, "count": len(array), "type": kind}
        if bounds:
            flat = array.reshape(len(array), -1)
            accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        self.doc["accessors"].append(accessor)
        self.data += array.tobytes() + b"\0" * (-array.nbytes % 4)
        return index


def _document(clip: Clip, plan: _Plan, boxes: Sequence[SceneBox]) -> tuple[dict[str, Any], bytes]:
    """The document, but for its buffer's place, and the buffer."""
    out = _Document()
    _add_nodes(out.doc["nodes"], clip, plan)
    _add_figure(out, clip, plan)
    _add_animation(out, clip, plan)
    tops = [0]
    for box in boxes:
        tops.append(len(out.doc["nodes"]))
        _add_box(out, box, plan)
    out.doc["scenes"] = [{"name": clip.name, "nodes": tops}]
    return out.doc, bytes(out.data)


def _glb(document: dict[str, Any], blob: bytes) -> bytes:
    """The GLB container: a header, the JSON chunk padded with spaces, the binary chunk."""
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", MAGIC, 2, 28 + len(text) + len(blob))
    chunks = [struct.pack("<II", len(d), k) + d for d, k in ((text, JSON_CHUNK), (blob, BIN_CHUNK))]
    return head + b"".join(chunks)


def _floats(v: np.ndarray) -> list[float]:
    return [float(x) + 0.0 for x in v]


def _add_nodes(nodes: list[dict[str, Any]], clip: Clip, plan: _Plan) -> None:
    """The static nodes above the root, each with the next as its only child, then the joints."""
    skeleton, first = clip.skeleton, len(plan.above)
    for i, (name, place, turn, scale) in enumerate(plan.above):
        nodes.append({**_node(name, place, turn), "scale": _floats(scale), "children": [i + 1]})
    tips: dict[int, list[list[float]]] = {}
    for j, tip in tips_from_z_up(skeleton, plan.axis, plan.unit_m):
        tips.setdefault(j, []).append(_floats(tip))
    for j, name in enumerate(skeleton.names):
        node = _node(name, plan.place[j], plan.rest[j])
        if below := [first + c for c in skeleton.children(j)]:
            node["children"] = below
        if plan.scale[j] != 1.0:
            node["scale"] = [float(plan.scale[j])] * 3
        if j in tips:
            node["extras"] = {"poise_ends": tips[j]}
        nodes.append(node)


def _node(name: str, place: np.ndarray, turn: np.ndarray) -> dict[str, Any]:
    return {"name": name, "translation": _floats(place), "rotation": _floats(turn[[1, 2, 3, 0]])}


def _rest_matrices(clip: Clip, plan: _Plan) -> np.ndarray:
    """`(J, 4, 4)` world transforms of the joints in the rest pose."""

    def matrix(place: np.ndarray, turn: np.ndarray, scale: np.ndarray) -> np.ndarray:
        out = np.eye(4)
        out[:3, :3] = quat_to_matrix(turn) * scale
        out[:3, 3] = place
        return out

    top = np.eye(4)
    for _, place, turn, scale in plan.above:
        top = top @ matrix(place, turn, scale)
    out: list[np.ndarray] = []
    for j, parent in enumerate(clip.skeleton.parents):
        local = matrix(plan.place[j], plan.rest[j], np.full(3, plan.scale[j]))
        out.append((top if parent < 0 else out[parent]) @ local)
    return np.stack(out)


def _add_figure(out: _Document, clip: Clip, plan: _Plan) -> None:
    """The skin, and a mesh; each of its vertices follows one joint."""
    first = len(plan.above)
    rest = _rest_matrices(clip, plan)
    inverse = np.linalg.inv(rest)
    inverse[:, 3] = (0.0, 0.0, 0.0, 1.0)
    joints = list(range(first, first + len(rest)))
    skeleton = clip.skeleton
    # Matrices are stored by columns.
    matrices = out.add(inverse.transpose(0, 2, 1).reshape(-1, 16), "MAT4")
    skin = {"name": "Poise", "joints": joints, "skeleton": first, "inverseBindMatrices": matrices}
    tips = []
    for j, tip in tips_from_z_up(skeleton, plan.axis, plan.unit_m):
        # Tips are rigid parts of their joints and know no scale.
        turn = rest[j, :3, :3] / np.linalg.norm(rest[j, :3, :3], axis=0)
        tips.append(
            (j, rest[j, :3, 3] + turn @ vectors_from_z_up(np.array(tip), plan.axis) / plan.unit_m)
        )
    points, normals, owner = bone_figure(skeleton.parents, rest[:, :3, 3], tips, 1.0 / plan.unit_m)
    bound = np.zeros((len(owner), 4))
    bound[:, 0] = owner
    weights = np.zeros((len(owner), 4))
    weights[:, 0] = 1.0
    component = _UBYTE if len(rest) <= 256 else _USHORT
    attributes = {
        "POSITION": out.add(points, "VEC3", target=_ARRAY, bounds=True),
        "NORMAL": out.add(normals, "VEC3", target=_ARRAY),
        "JOINTS_0": out.add(bound, "VEC4", component, _ARRAY),
        "WEIGHTS_0": out.add(weights, "VEC4", target=_ARRAY),
    }
    look = {"baseColorFactor": _COLOUR, "metallicFactor": 0.0, "roughnessFactor": 0.7}
    primitive = {"attributes": attributes, "material": 0}
    out.doc["skins"] = [skin]
    out.doc["materials"] = [{"name": "Poise", "pbrMetallicRoughness": look}]
    out.doc["meshes"] = [{"name": "Figure", "primitives": [primitive]}]
    nodes = out.doc["nodes"]
    nodes.append({"name": "Figure", "mesh": 0, "skin": 0})
    # The transforms above a skinned mesh do not move its vertices, only where viewers look for it.
    travels = max(plan.paths, key=lambda j: float(np.ptp(plan.paths[j], axis=0).max()))
    nodes[first + travels].setdefault("children", []).append(len(nodes) - 1)


def _add_box(out: _Document, box: SceneBox, plan: _Plan) -> None:
    """A node with the mesh of a box; all boxes share a material."""
    points, normals, centre = box_mesh(box, plan.axis, plan.unit_m)
    attributes = {
        "POSITION": out.add(points, "VEC3", target=_ARRAY, bounds=True),
        "NORMAL": out.add(normals, "VEC3", target=_ARRAY),
    }
    if len(out.doc["materials"]) == 1:
        look = {"baseColorFactor": _WOOD, "metallicFactor": 0.0, "roughnessFactor": 0.9}
        out.doc["materials"].append({"name": "Support", "pbrMetallicRoughness": look})
    primitive = {"attributes": attributes, "material": 1}
    mesh = len(out.doc["meshes"])
    out.doc["meshes"].append({"name": box.name, "primitives": [primitive]})
    out.doc["nodes"].append({"name": box.name, "mesh": mesh, "translation": _floats(centre)})


def _add_animation(out: _Document, clip: Clip, plan: _Plan) -> None:
    """One translation channel per joint that travels, one rotation channel per joint."""
    source = clip.skeleton.source
    step = 1.0 / clip.fps
    if source.frame_time and abs(source.frame_time * clip.fps - 1.0) < 1e-9:
        step = source.frame_time
    times = out.add(np.arange(clip.frames) * step, "SCALAR", bounds=True)
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []

    def channel(joint: int, path: str, values: np.ndarray, kind: str) -> None:
        target = {"node": len(plan.above) + joint, "path": path}
        channels.append({"sampler": len(samplers), "target": target})
        samplers.append({"input": times, "output": out.add(values, kind), "interpolation": "LINEAR"})

    for j, path in sorted(plan.paths.items()):
        channel(j, "translation", path, "VEC3")
    for j in range(len(clip.skeleton)):
        channel(j, "rotation", plan.turns[:, j][:, [1, 2, 3, 0]], "VEC4")
    own = {"fps": clip.fps, "frame_time": step, "cyclic": clip.cyclic}
    animation = {"name": plan.take, "channels": channels, "samplers": samplers}
    out.doc["animations"] = [{**animation, "extras": {"poise": own}}]
