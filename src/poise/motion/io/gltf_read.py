"""A glTF animation as a clip: skinned or plain node trees, .glb or .gltf."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.info import body_height, sampled
from poise.motion.io.gltf_file import GltfFile, load_gltf
from poise.motion.io.gltf_tracks import Take, choose_take, clock, number_of
from poise.motion.io.gltf_tree import Tree, choose_joints, read_tree
from poise.motion.io.guess import guess_unit, guess_up
from poise.motion.io.raw import Options, RawMotion, assemble
from poise.motion.io.text import MAX_JOINTS, shown
from poise.spatial import forward_kinematics, quat_mul, quat_rotate

# As for BVH: a joint whose translation stays within this share of the skeleton's size is rigid.
_RIGID_SHARE = 6e-4
_TRAVEL_SHARE = 20 * _RIGID_SHARE
_EVEN_SCALE = 1e-2
_METRES_BAND = (0.3, 4.0)


def read_gltf(path: Path, options: Options) -> Clip:
    """A glTF 2.0 clip (.glb, .gltf).

    Local node rotations are the clip's local rotations. The transforms of nodes above the root
    joint, such as an armature's scale of 0.01, and constant scales are baked into the bones and the
    root's path, and remembered for `write_gltf`. Of several animations the longest is taken, or
    `options.take`. glTF is in metres and Y up; a body of no human size is taken for centimetres or
    another unit, with a note.
    """
    file = load_gltf(path)
    tree = read_tree(file)
    notes: list[str] = []
    take = choose_take(file, tree, options.take, notes)
    targeted = take.nodes("translation", "rotation")
    moving = take.nodes("translation", "rotation", varying=True)
    joints = choose_joints(tree, file, targeted, moving, notes)
    joints = _without_still_roots(tree, joints, take, moving)
    if len(joints) > MAX_JOINTS:
        raise PoiseError(f"it has {len(joints)} joints, more than the {MAX_JOINTS} allowed", path)
    raw = _raw_motion(file, tree, take, joints, options, notes)
    return assemble(raw, options)


def _without_still_roots(tree: Tree, joints: list[int], take: Take, moving: set[int]) -> list[int]:
    """Leaves out root joints that never move and carry one joint, which does the travelling.

    They become static nodes above the root, and come back when the clip is written.
    """
    travelling = take.nodes("translation", varying=True)
    while joints[0] not in moving:
        below = [j for j in joints if tree.parents[j] == joints[0]]
        if len(below) != 1 or below[0] not in travelling:
            break
        joints = joints[1:]
    return joints


def _raw_motion(
    file: GltfFile, tree: Tree, take: Take, joints: list[int], options: Options, notes: list[str]
) -> RawMotion:
    above = tree.line(joints[0])[:-1]
    used = [
        take.tracks[n, p] for n in joints for p in ("translation", "rotation") if (n, p) in take.tracks
    ]
    when, fps = clock(take, used, options.fps, file, notes)
    place = {n: _channel(tree, take, n, "translation", when) for n in (*above, *joints)}
    turn = {n: _channel(tree, take, n, "rotation", when) for n in (*above, *joints)}
    scale = {n: _scale(tree, take, n, file, notes) for n in (*above, *joints)}
    names = _unique([tree.names[j] for j in joints], notes)
    index = {node: j for j, node in enumerate(joints)}
    parents = tuple(index.get(tree.parents[n], -1) if j else -1 for j, n in enumerate(joints))
    base = _base(above, place, turn, scale)
    # The product of all scales above a node, without its own.
    factor = {joints[0]: base.factor * _even(base.scale)}
    offsets = np.zeros((len(joints), 3))
    paths: dict[int, np.ndarray] = {}
    for j, node in enumerate(joints[1:], 1):
        up = joints[parents[j]]
        factor[node] = factor[up] * _even(scale[up])
        path = factor[up] * scale[up] * place[node]
        offsets[j] = np.median(path, axis=0)
        paths[j] = path
    rot = np.stack([np.broadcast_to(turn[n], (len(when), 4)) for n in joints], 1)
    rot[:, 0] = quat_mul(torch.tensor(base.turn).expand(len(when), 4), torch.tensor(rot[:, 0])).numpy()
    root_pos = base.place + _turned(base.turn, base.factor * base.scale * place[joints[0]])
    root_pos = np.broadcast_to(root_pos, (len(when), 3))
    size = float(np.linalg.norm(offsets[1:], axis=-1).sum()) / 4 + 1e-12
    travel, root_pos, still = _lift_travel(names, parents, offsets, paths, root_pos, rot, size, notes)
    strays = [
        (names[j], float(np.linalg.norm(p - offsets[j], axis=-1).max()))
        for j, p in paths.items()
        if j != travel
    ]
    own = take.extras
    kept = {
        "above": [
            [tree.names[n], place[n][0].tolist(), turn[n][0].tolist(), scale[n].tolist()] for n in above
        ],
        "scale": [_even(scale[n]) for n in joints],
        "rest": tree.turn[joints].tolist(),
        "root": tree.place[joints[0]].tolist(),
        "still": still,
        "take": take.name,
    }
    unit_m = _unit(names, parents, offsets, root_pos, rot, options, file.path, notes)
    return RawMotion(
        format="gltf",
        path=file.path,
        names=names,
        parents=parents,
        offsets=offsets,
        ends=_ends(file, joints),
        root_pos=np.array(root_pos),
        rot=rot,
        fps=fps,
        channels=(),
        frame_time=number_of(own.get("frame_time")),
        unit_m=unit_m,
        up_axis="Y",
        travel_joint=None if travel is None else names[travel],
        cyclic=own.get("cyclic") is True,
        notes=tuple(notes),
        strays=tuple((n, s) for n, s in strays if s > _RIGID_SHARE * size),
        extra=(("gltf", json.dumps(kept)),),
        whole="fps" in own,
    )


def _channel(tree: Tree, take: Take, node: int, path: str, when: np.ndarray) -> np.ndarray:
    """`(T or 1, n)` values of a node's channel, or of its rest pose where it has none."""
    track = take.tracks.get((node, path))
    if track is None:
        return (tree.place if path == "translation" else tree.turn)[node][None]
    return track.at(when) if track.varies() else track.keys()[:1]


def _scale(tree: Tree, take: Take, node: int, file: GltfFile, notes: list[str]) -> np.ndarray:
    """`(3,)` a node's constant scale; an animated one is told and replaced by its median."""
    name, track = tree.names[node], take.tracks.get((node, "scale"))
    value = tree.scale[node] if track is None else np.median(track.keys(), axis=0)
    if track is not None and np.ptp(track.keys(), axis=0).max() > _EVEN_SCALE * np.abs(value).max():
        notes.append(f"The scale of '{name}' is animated; its median was taken for all frames")
    if value.min() <= 0:
        what = "mirrors space" if value.min() < 0 else "is zero"
        raise PoiseError(f"the scale of node '{name}' {what}, which no body can follow", file.path)
    if value.max() > (1 + _EVEN_SCALE) * value.min():
        notes.append(
            f"The scale of '{name}' differs between its axes; below its children the mean is used"
        )
    return value


def _even(scale: np.ndarray) -> float:
    """The one factor nearest to a scale: its geometric mean."""
    return float(np.cbrt(np.prod(scale)))


@dataclass(frozen=True)
class Base:
    """What lies above the root joint: p_world = place + R factor (scale * p), R = `turn` (wxyz)."""

    place: np.ndarray
    turn: np.ndarray
    factor: float
    scale: np.ndarray


def _base(
    above: list[int],
    place: dict[int, np.ndarray],
    turn: dict[int, np.ndarray],
    scale: dict[int, np.ndarray],
) -> Base:
    return base_of([(place[n][0], turn[n][0], scale[n]) for n in above])


def base_of(nodes: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Base:
    """The combined transform of nested nodes `(place, turn, scale)`, outermost first."""
    out = Base(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), 1.0, np.ones(3))
    for place, turn, scale in nodes:
        out = Base(
            out.place + _turned(out.turn, out.factor * out.scale * place),
            quat_mul(torch.tensor(out.turn), torch.tensor(turn)).numpy(),
            out.factor * _even(out.scale),
            np.array(scale, dtype=np.float64),
        )
    return out


def _turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors `v (..., 3)` turned by one rotation."""
    return quat_rotate(torch.tensor(q).expand(*v.shape[:-1], 4), torch.tensor(v)).numpy()


def _lift_travel(
    names: tuple[str, ...],
    parents: tuple[int, ...],
    offsets: np.ndarray,
    paths: dict[int, np.ndarray],
    root_pos: np.ndarray,
    rot: np.ndarray,
    size: float,
    notes: list[str],
) -> tuple[int | None, np.ndarray, list[float] | None]:
    """Moves the travel of a joint near the root into the root's path; its offset becomes zero.

    The joint is the first on the way down that carries more than half of the joints and moves
    against its parent. Returns it, the new path and, where the root stood still, its place.
    """
    weight = np.ones(len(parents), dtype=int)
    for j in range(len(parents) - 1, 0, -1):
        weight[parents[j]] += weight[j]
    joint = 0
    still = bool(np.abs(root_pos - root_pos[0]).max() <= _RIGID_SHARE * size)
    only = True
    while True:
        heavy = [j for j, p in enumerate(parents) if p == joint and 2 * weight[j] > weight[0]]
        only = only and parents.count(joint) == 1
        # Below a root that moves and branches, bones stay rigid and what moves is told as a stray.
        if not heavy or not (only or still):
            return None, root_pos, None
        joint = heavy[0]
        slack = (_RIGID_SHARE if only else _TRAVEL_SHARE) * size
        if np.linalg.norm(paths[joint] - offsets[joint], axis=-1).max() > slack:
            break
    offsets[joint] = 0.0
    root, hips = names[0], names[joint]
    if still:
        notes.append(f"The root '{root}' stands still: the travel of '{hips}' became the root's path")
    else:
        notes.append(f"Both the root '{root}' and '{hips}' travel; the path of both became the root's")
    _, quat = forward_kinematics(
        parents, torch.tensor(offsets), torch.tensor(np.array(root_pos)), torch.tensor(rot)
    )
    moved = quat_rotate(quat[:, parents[joint]], torch.tensor(paths[joint]).expand(len(rot), 3))
    return joint, root_pos + moved.numpy(), root_pos[0].tolist() if still else None


def _unique(names: list[str], notes: list[str]) -> tuple[str, ...]:
    """The names, with a number added to those that appear again."""
    out: list[str] = []
    seen: set[str] = set()
    for name in names:
        made, k = name, 2
        while made in seen:
            made, k = f"{name}_{k}", k + 1
        if made != name:
            notes.append(
                f"The joint name {shown(name)} appears twice; the later one is called {shown(made)}"
            )
        seen.add(made)
        out.append(made)
    return tuple(out)


def _ends(file: GltfFile, joints: list[int]) -> tuple[tuple[int, tuple[float, float, float]], ...]:
    """Bone tips that Poise wrote beside the nodes, in file units."""
    out: list[tuple[int, tuple[float, float, float]]] = []
    for j, node in enumerate(joints):
        extras = file.doc.nodes[node].extras
        tips = extras.get("poise_ends") if isinstance(extras, dict) else None
        for tip in tips if isinstance(tips, list) else []:
            if isinstance(tip, list) and len(tip) == 3 and all(type(x) in (int, float) for x in tip):
                x, y, z = (float(v) for v in tip)
                if max(abs(x), abs(y), abs(z)) < 1e6:
                    out.append((j, (x, y, z)))
    return tuple(out)


def _unit(
    names: tuple[str, ...],
    parents: tuple[int, ...],
    offsets: np.ndarray,
    root_pos: np.ndarray,
    rot: np.ndarray,
    options: Options,
    path: Path,
    notes: list[str],
) -> float | None:
    """Metres in one file unit: 1, as glTF demands, unless the body would then be no human's size."""
    if len(root_pos) < 2 or not np.abs(offsets).max() > 0:
        return None
    at = sampled(len(rot))
    pos = forward_kinematics(
        parents, torch.tensor(offsets), torch.tensor(root_pos[at]), torch.tensor(rot[at])
    )[0].numpy()
    up = guess_up(names, pos, pos[0])
    if options.up_axis is None and up.value != "Y" and "uncertain" not in up.note:
        notes.append(
            "glTF is Y up and was read so, but the body stands along Z; if it should stand upright, "
            "override with --up Z"
        )
    height, how = body_height(names, parents, offsets, pos)
    if options.unit_m is not None or not height > 0 or _METRES_BAND[0] <= height <= _METRES_BAND[1]:
        return 1.0
    unit = float(guess_unit(height, how, None, path).value)
    notes.append(
        f"glTF is in metres, but the person would be {height:.4g} m tall: one unit is taken as "
        f"{unit:.6g} m, which makes it {height * unit:.2f} m ({how})"
    )
    return unit
