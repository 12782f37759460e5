"""A BVH file as a clip: each joint's own channel order, position channels of any joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from poise.motion.clip import Clip
from poise.motion.io.angle_units import few_degrees_note
from poise.motion.io.bvh.file import POSITIONS, BvhFile, parse_bvh
from poise.motion.io.nodes import RIGID_SHARE, lifted, travel_note
from poise.motion.io.raw import BLOCK, RawMotion, ReadOptions, assemble
from poise.motion.io.text import listed
from poise.motion.skeleton import Channel
from poise.spatial import euler_to_quat, quat_mul, quat_rotate, quat_rotate_inv


def read_bvh(path: Path, options: ReadOptions) -> Clip:
    """A BVH clip.

    A joint's position channels replace its OFFSET, the root's too (LAFAN1 writes the first
    position into both). Where the root stands still and a joint below it carries the travel
    (Bandai: Hips), the travel becomes the clip's root path and that joint's offset zero, so that
    every joint from there on moves as in the file.
    """
    file = parse_bvh(path)
    joints, rot = file.joints, _rotations(file)
    places = _resolve_places(file, rot)
    notes = [*file.notes, *places.notes, *few_degrees_note(_angles(file))]
    flat = [
        joints[j].name
        for j in range(1, len(joints))
        if not places.offsets[j].any() and j != places.travel
    ]
    if flat:
        notes.append(f"Bones of no length lead to {listed(flat)}")
    raw = RawMotion(
        format="bvh",
        path=path,
        names=tuple(j.name for j in joints),
        parents=tuple(j.parent for j in joints),
        offsets=places.offsets,
        ends=tuple((i, tip) for i, j in enumerate(joints) for tip in j.tips),
        root_pos=places.root_pos,
        rot=rot,
        fps=1.0 / file.frame_time,
        channels=tuple(Channel(order=j.channels or ()) for j in joints),
        frame_time=file.frame_time,
        travel_joint=None if places.travel is None else joints[places.travel].name,
        notes=tuple(notes),
        strays=tuple(places.strays),
        extra=tuple(places.extra),
    )
    return assemble(raw, options)


def _angles(file: BvhFile) -> dict[str, np.ndarray]:
    """The rotation channels `(T, C)` of each joint but the root, degrees as the format has them."""
    out, column = {}, 0
    for j, joint in enumerate(file.joints):
        channels = joint.channels or ()
        turns = [column + i for i, c in enumerate(channels) if c.endswith("rotation")]
        column += len(channels)
        if j and turns:
            out[joint.name] = file.values[:, turns]
    return out


def _rotations(file: BvhFile) -> np.ndarray:
    """`(T, J, 4)` local rotations; each joint's axes in the order of its rotation channels."""
    out = np.zeros((len(file.values), len(file.joints), 4))
    out[..., 0] = 1.0
    groups: dict[str, list[tuple[int, list[int]]]] = {}
    column = 0
    for j, joint in enumerate(file.joints):
        channels = joint.channels or ()
        turns = [(c[0], column + i) for i, c in enumerate(channels) if c.endswith("rotation")]
        column += len(channels)
        if turns:
            groups.setdefault("".join(t[0] for t in turns), []).append((j, [t[1] for t in turns]))
    for order, members in groups.items():
        columns = torch.tensor([c for _, c in members])
        for at in range(0, len(out), BLOCK):
            radians = torch.tensor(np.radians(file.values[at : at + BLOCK]))
            turned = euler_to_quat(radians[:, columns], order).numpy()
            out[at : at + BLOCK, [j for j, _ in members]] = turned
    return out


@dataclass
class _Places:
    """What the position channels amount to, in file units.

    offsets `(J, 3)`: one rigid offset per joint. root_pos `(T, 3)`. travel: the joint with the
    channels that carry the travel, or None. strays: `(joint, largest distance)` from the offset.
    extra: what a writer must know to restore the channels.
    """

    offsets: np.ndarray
    root_pos: np.ndarray
    travel: int | None = None
    notes: list[str] = field(default_factory=list)
    strays: list[tuple[str, float]] = field(default_factory=list)
    extra: list[tuple[str, str]] = field(default_factory=list)


def _resolve_places(file: BvhFile, rot: np.ndarray) -> _Places:
    """Turns the position channels of all joints into rigid offsets and one root path.

    Position channels replace the OFFSET, the root's too. Three dialects are told apart: channels
    that stay constant; a joint below the root that carries the travel (the root may stand still); and
    channels that hold world positions, which fit a rigid bone far better read so.
    """
    joints = file.joints
    names = [j.name for j in joints]
    parents = [j.parent for j in joints]
    offsets = np.array([j.offset for j in joints], dtype=float)
    moves = _moves(file)
    size = float(np.linalg.norm(offsets[1:], axis=-1).sum()) / 4 + 1e-12
    tolerance = RIGID_SHARE * size
    out = _Places(offsets, moves.pop(0, np.tile(offsets[0], (len(rot), 1))))
    out.extra.append(("offset:0", _text(offsets[0])))
    if offsets[0].any() and any(c in POSITIONS for c in joints[0].channels or ()):
        out.notes.append("The root's OFFSET is not added to its position channels")
    offsets[0] = 0.0
    travel = out.travel = _travel_joint(parents, moves, tolerance)
    path = np.zeros(0) if travel is None else moves.pop(travel)
    if travel is not None:
        both = not _still(out.root_pos, tolerance)
        out.notes.append(travel_note(names[0], names[travel], both))
    loose = any(np.abs(m - np.median(m, axis=0)).max() > tolerance for m in moves.values())
    world = _from_world(parents, offsets, out.root_pos, rot, moves, tolerance) if loose else []
    if world:
        out.extra.append(("world_positions", " ".join(map(str, world))))
        these = ", ".join(f"'{names[j]}'" for j in world)
        out.notes.append(f"The position channels of {these} hold places in the world")
    for j, places in moves.items():
        _keep_rigid(out, j, names[j], places, tolerance)
    if travel is not None:
        out.extra.append((f"offset:{travel}", _text(offsets[travel])))
        out.extra.append(("root_position", _text(out.root_pos[0])))
        offsets[travel] = 0.0
        out.root_pos = lifted(parents, offsets, out.root_pos, rot, travel, path)
    return out


def _moves(file: BvhFile) -> dict[int, np.ndarray]:
    """`(T, 3)` positions of each joint with position channels, missing axes from the OFFSET."""
    out: dict[int, np.ndarray] = {}
    column = 0
    for j, joint in enumerate(file.joints):
        channels = joint.channels or ()
        if any(c in POSITIONS for c in channels):
            place = np.tile(np.array(joint.offset, dtype=float), (len(file.values), 1))
            for i, channel in enumerate(channels):
                if channel in POSITIONS:
                    place[:, POSITIONS.index(channel)] = file.values[:, column + i]
            out[j] = place
        column += len(channels)
    return out


def _text(v: np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in v)


def _still(path: np.ndarray, tolerance: float) -> bool:
    return bool(np.abs(path - path[0]).max() <= tolerance)


def _travel_joint(parents: Sequence[int], moves: dict[int, np.ndarray], tolerance: float) -> int | None:
    """The joint that carries the travel instead of the root, or together with it.

    It is sought down from the root as long as each joint is the only child of its parent.
    """
    joint = 0
    while True:
        children = [i for i, parent in enumerate(parents) if parent == joint]
        if len(children) != 1:
            return None
        joint = children[0]
        if joint in moves and not _still(moves[joint], tolerance):
            return joint


def _from_world(
    parents: Sequence[int],
    offsets: np.ndarray,
    root_pos: np.ndarray,
    rot: np.ndarray,
    moves: dict[int, np.ndarray],
    tolerance: float,
) -> list[int]:
    """Joints with channels that are world positions; `moves` gets them in the parent's frame."""
    pos, quat = [torch.tensor(root_pos)], [torch.tensor(rot[:, 0])]
    found: list[int] = []
    for j, up in enumerate(parents):
        if up < 0:
            continue
        places = moves.get(j)
        local = torch.tensor(np.tile(offsets[j], (len(rot), 1)) if places is None else places)
        if places is not None and _stray(places) > tolerance:
            inside = quat_rotate_inv(quat[up], torch.tensor(places) - pos[up])
            if _stray(inside.numpy()) < 0.5 * _stray(places):
                found.append(j)
                moves[j], local = inside.numpy(), inside
        pos.append(pos[up] + quat_rotate(quat[up], local))
        quat.append(quat_mul(quat[up], torch.tensor(rot[:, j])))
    return found


def _stray(path: np.ndarray) -> float:
    return float(np.linalg.norm(path - np.median(path, axis=0), axis=-1).max())


def _keep_rigid(out: _Places, j: int, name: str, path: np.ndarray, tolerance: float) -> None:
    """Gives joint `j` the median of its position channels as its offset, and tells about it."""
    middle = np.median(path, axis=0)
    stray = _stray(path)
    if stray > tolerance:
        out.strays.append((name, stray))
    elif np.linalg.norm(middle - out.offsets[j]) > tolerance:
        out.notes.append(f"The position channels of joint '{name}' replace its OFFSET")
    if not np.array_equal(middle, out.offsets[j]):
        out.extra.append((f"offset:{j}", _text(out.offsets[j])))
    out.offsets[j] = middle
