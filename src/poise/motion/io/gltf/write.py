"""Clips as glTF: the source's nodes, their motion, and a skinned figure to look at."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from poise.motion.clip import Clip
from poise.motion.io.figure import bone_figure
from poise.motion.io.nodes import base_of, place_of_travel, tips_from_z_up
from poise.motion.io.raw import quats_from_z_up, vectors_from_z_up
from poise.motion.io.text import write_whole
from poise.spatial import (
    normalize,
    quat_conj,
    quat_mul,
    quat_to_matrix,
    unwrap_quats,
)

_FLOAT, _UBYTE, _USHORT = 5126, 5121, 5123
_ARRAY = 34962
_COLOUR = [0.85, 0.45, 0.15, 1.0]
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


def write_gltf(clip: Clip, path: str | Path) -> None:
    """Writes a clip as .glb, or as .gltf with its buffer embedded.

    A clip that came from glTF gets back its nodes above the root, scales, rest pose, unit and the
    name of its animation; any other is in metres. Always Y up. A skin binds a figure of slim
    octahedra to the joints, so that viewers show the motion at once. Keys stand at the clip's own
    frames; bone tips, the exact frame rate and `cyclic` are kept in `extras`.

    Raises:
        PoiseError: the folder is missing or cannot be written to.
    """
    path = Path(path)
    plan = _plan(clip)
    document = _document(clip, plan)
    if path.suffix.lower() == ".gltf":
        blob = bytes(document.binary_blob())
        text = base64.b64encode(blob).decode("ascii")
        document.buffers[0].uri = f"data:application/octet-stream;base64,{text}"
        write_whole(path, document.gltf_to_json() + "\n")
    else:
        write_whole(path, b"".join(document.save_to_bytes()))


def _plan(clip: Clip) -> _Plan:
    skeleton, source = clip.skeleton, clip.skeleton.source
    kept = _kept(clip)
    unit, axis = (source.unit_m, source.up_axis) if kept else (1.0, "Y")
    count = len(skeleton)
    rot = torch.tensor(quats_from_z_up(clip.rot, axis))
    root_pos = vectors_from_z_up(clip.root_pos, axis) / unit
    offsets = vectors_from_z_up(skeleton.offsets, axis) / unit
    above = [(n, np.array(p), np.array(q), np.array(s)) for n, p, q, s in kept.get("above", [])]
    scale = np.array(kept.get("scale", np.ones(count)))
    base = base_of([(p, q, s) for _, p, q, s in above])
    paths = {0: root_pos}
    if kept.get("still") is not None and source.travel_joint in skeleton.names:
        paths = place_of_travel(skeleton, offsets, root_pos, rot, np.array(kept["still"]))
    paths[0] = base.down(paths[0])
    rot[:, 0] = quat_mul(quat_conj(torch.tensor(base.turn)).expand(len(rot), 4), rot[:, 0])
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
        unwrap_quats(normalize(rot)).numpy(),
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


class _Buffer:
    """Collects accessors in one binary buffer, each aligned to four bytes."""

    def __init__(self) -> None:
        from pygltflib import GLTF2

        self.doc = GLTF2()
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
        from pygltflib import Accessor, BufferView

        dtype = {_FLOAT: "<f4", _UBYTE: "<u1", _USHORT: "<u2"}[component]
        array = np.ascontiguousarray(values, dtype=dtype)
        if dtype == "<f4":
            # Without -0, so that files of the same motion are the same.
            array = array + np.float32(0)
        self.data += b"\0" * (-len(self.data) % 4)
        view = BufferView(buffer=0, byteOffset=len(self.data), byteLength=array.nbytes, target=target)
        self.data += array.tobytes()
        flat = array.reshape(len(array), -1)
        accessor = Accessor(
            bufferView=len(self.doc.bufferViews), componentType=component, count=len(array), type=kind
        )
        if bounds:
            accessor.min = [float(x) for x in flat.min(0)]
            accessor.max = [float(x) for x in flat.max(0)]
        self.doc.bufferViews.append(view)
        self.doc.accessors.append(accessor)
        return len(self.doc.accessors) - 1


def _document(clip: Clip, plan: _Plan) -> Any:
    from pygltflib import Asset, Buffer, Scene

    out = _Buffer()
    first = len(plan.above)
    _add_nodes(out.doc, clip, plan)
    _add_figure(out, clip, plan, first)
    _add_animation(out, clip, plan, first)
    doc = out.doc
    doc.asset = Asset(version="2.0", generator="Poise")
    doc.scene = 0
    doc.scenes = [Scene(name=clip.name, nodes=[0, len(doc.nodes) - 1])]
    out.data += b"\0" * (-len(out.data) % 4)
    doc.buffers = [Buffer(byteLength=len(out.data))]
    doc.set_binary_blob(bytes(out.data))
    return doc


def _xyzw(q: np.ndarray) -> list[float]:
    return [float(x) + 0.0 for x in (q[1], q[2], q[3], q[0])]


def _floats(v: np.ndarray) -> list[float]:
    return [float(x) + 0.0 for x in v]


def _add_nodes(doc: Any, clip: Clip, plan: _Plan) -> None:
    """The static nodes above the root, each with the next as its only child, then the joints."""
    from pygltflib import Node

    skeleton, first = clip.skeleton, len(plan.above)
    for i, (name, place, turn, scale) in enumerate(plan.above):
        doc.nodes.append(
            Node(
                name=name,
                translation=_floats(place),
                rotation=_xyzw(turn),
                scale=_floats(scale),
                children=[i + 1],
            )
        )
    tips: dict[int, list[list[float]]] = {}
    for j, tip in tips_from_z_up(skeleton, plan.axis, plan.unit_m):
        tips.setdefault(j, []).append(_floats(tip))
    for j, name in enumerate(skeleton.names):
        node = Node(
            name=name,
            translation=_floats(plan.place[j]),
            rotation=_xyzw(plan.rest[j]),
            children=[first + c for c in skeleton.children(j)],
        )
        if plan.scale[j] != 1.0:
            node.scale = [float(plan.scale[j])] * 3
        if j in tips:
            node.extras = {"poise_ends": tips[j]}
        doc.nodes.append(node)


def _rest_matrices(clip: Clip, plan: _Plan) -> np.ndarray:
    """`(J, 4, 4)` world transforms of the joints in the rest pose."""

    def matrix(place: np.ndarray, turn: np.ndarray, scale: np.ndarray) -> np.ndarray:
        out = np.eye(4)
        out[:3, :3] = quat_to_matrix(torch.tensor(turn)).numpy() * scale
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


def _add_figure(out: _Buffer, clip: Clip, plan: _Plan, first: int) -> None:
    """The skin, and a mesh whose vertices each follow one joint."""
    from pygltflib import Attributes, Material, Mesh, Node, PbrMetallicRoughness, Primitive, Skin

    rest = _rest_matrices(clip, plan)
    inverse = np.linalg.inv(rest)
    inverse[:, 3] = (0.0, 0.0, 0.0, 1.0)
    joints = list(range(first, first + len(rest)))
    skeleton, doc = clip.skeleton, out.doc
    # Matrices are stored by columns.
    matrices = out.add(inverse.transpose(0, 2, 1).reshape(-1, 16), "MAT4")
    doc.skins.append(Skin(name="Poise", joints=joints, skeleton=first, inverseBindMatrices=matrices))
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
    attributes = Attributes(
        POSITION=out.add(points, "VEC3", target=_ARRAY, bounds=True),
        NORMAL=out.add(normals, "VEC3", target=_ARRAY),
        JOINTS_0=out.add(bound, "VEC4", component, _ARRAY),
        WEIGHTS_0=out.add(weights, "VEC4", target=_ARRAY),
    )
    look = PbrMetallicRoughness(baseColorFactor=_COLOUR, metallicFactor=0.0, roughnessFactor=0.7)
    doc.materials.append(Material(name="Poise", pbrMetallicRoughness=look))
    doc.meshes.append(Mesh(name="Figure", primitives=[Primitive(attributes=attributes, material=0)]))
    doc.nodes.append(Node(name="Figure", mesh=0, skin=0))


def _add_animation(out: _Buffer, clip: Clip, plan: _Plan, first: int) -> None:
    """One translation channel per joint that travels, one rotation channel per joint."""
    from pygltflib import Animation, AnimationChannel, AnimationChannelTarget, AnimationSampler

    source = clip.skeleton.source
    step = 1.0 / clip.fps
    if source.frame_time and abs(source.frame_time * clip.fps - 1.0) < 1e-9:
        step = source.frame_time
    times = out.add(np.arange(clip.frames) * step, "SCALAR", bounds=True)
    animation = Animation(name=plan.take)
    animation.extras = {"poise": {"fps": clip.fps, "frame_time": step, "cyclic": clip.cyclic}}

    def channel(joint: int, path: str, values: np.ndarray, kind: str) -> None:
        sampler = AnimationSampler(input=times, output=out.add(values, kind), interpolation="LINEAR")
        target = AnimationChannelTarget(node=first + joint, path=path)
        animation.channels.append(AnimationChannel(sampler=len(animation.samplers), target=target))
        animation.samplers.append(sampler)

    for j, path in sorted(plan.paths.items()):
        channel(j, "translation", path, "VEC3")
    for j in range(len(clip.skeleton)):
        channel(j, "rotation", plan.turns[:, j][:, [1, 2, 3, 0]], "VEC4")
    out.doc.animations.append(animation)
