"""A BVH file as a clip: each joint's own channel order, position channels of any joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from poise.motion.clip import Clip
from poise.motion.io.angle_units import few_degrees_note
from poise.motion.io.bvh.file import POSITIONS, BvhFile, parse_bvh
from poise.motion.io.raw import BLOCK, RawMotion, ReadOptions, assemble
from poise.motion.io.text import listed
from poise.motion.io.travel import RIGID_SHARE, Carried, carried, size_of, text_of
from poise.motion.skeleton import Channel
from poise.spatial import euler_to_quat, quat_mul, quat_rotate, quat_rotate_inv


def read_bvh(path: Path, options: ReadOptions) -> Clip:
    """A BVH clip.

    A joint's position channels replace its OFFSET, the root's too (LAFAN1 writes the first
    position into both). Where a joint below the root carries the body (Bandai: Hips, Unreal: pelvis),
    its travel becomes the clip's root path and its offset zero, so that every joint from there on moves
    as in the file, see `travel.carried`.
    """
    file = parse_bvh(path, options.rest)
    joints, rot = file.joints, _rotations(file)
    places = _resolve_places(file, rot)
    body = places.body
    notes = [*file.notes, *places.notes, *few_degrees_note(_angles(file))]
    flat = [
        joints[j].name for j in range(1, len(joints)) if not body.offsets[j].any() and j != body.joint
    ]
    if flat:
        notes.append(f"Bones of no length lead to {listed(flat)}")
    raw = RawMotion(
        format="bvh",
        path=path,
        names=tuple(j.name for j in joints),
        parents=tuple(j.parent for j in joints),
        offsets=body.offsets,
        ends=tuple((i, tip) for i, j in enumerate(joints) for tip in j.tips),
        root_pos=body.root_pos,
        rot=rot,
        fps=1.0 / file.frame_time,
        channels=tuple(Channel(order=j.channels or ()) for j in joints),
        frame_time=file.frame_time,
        travel_joint=None if body.joint is None else joints[body.joint].name,
        notes=tuple(notes),
        strays=body.strays,
        beside=body.beside,
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


@dataclass(frozen=True)
class _Places:
    """What the position channels amount to, in file units.

    body: rigid offsets, one root path, and what did not stay rigid. notes; extra: what a writer must
    know to restore the channels.
    """

    body: Carried
    notes: list[str]
    extra: list[tuple[str, str]]


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
    size = size_of(offsets)
    tolerance = RIGID_SHARE * size
    root_pos = moves.pop(0, np.tile(offsets[0], (len(rot), 1)))
    notes: list[str] = []
    extra = [("offset:0", text_of(offsets[0]))]
    if offsets[0].any() and any(c in POSITIONS for c in joints[0].channels or ()):
        notes.append("The root's OFFSET is not added to its position channels")
    offsets[0] = 0.0
    loose = any(np.abs(m - np.median(m, axis=0)).max() > tolerance for m in moves.values())
    world = _from_world(parents, offsets, root_pos, rot, moves, tolerance) if loose else []
    if world:
        extra.append(("world_positions", " ".join(map(str, world))))
        notes.append(
            f"The position channels of {listed(repr(names[j]) for j in world)} hold places in the world"
        )
    own = offsets.copy()
    for j, places in moves.items():
        offsets[j] = np.median(places, axis=0)
    body = carried(names, parents, offsets, moves, root_pos, rot, size, notes)
    told = {name for name, _ in (*body.strays, *body.beside)}
    for j in moves:
        if np.array_equal(offsets[j], own[j]):
            continue
        extra.append((f"offset:{j}", text_of(own[j])))
        far = np.linalg.norm(offsets[j] - own[j]) > tolerance
        if far and names[j] not in told and j != body.joint:
            notes.append(f"The position channels of joint '{names[j]}' replace its OFFSET")
    return _Places(body, notes, [*extra, *body.extra])


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
