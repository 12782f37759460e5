"""A BVH file as a clip: each joint's own channel order, position channels of any joint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from poise.motion.clip import Clip
from poise.motion.io.bvh.file import BvhFile, parse_bvh
from poise.motion.io.bvh.places import resolve_places
from poise.motion.io.raw import RawMotion, ReadOptions, assemble, zero_length_note
from poise.motion.skeleton import Channel
from poise.spatial import euler_to_quat


def read_bvh(path: Path, options: ReadOptions) -> Clip:
    """A BVH clip.

    A joint's position channels replace its OFFSET, the root's too (LAFAN1 writes the first
    position into both). Where the root stands still and a joint below it carries the travel
    (Bandai: Hips), the travel becomes the clip's root path and that joint's offset zero, so that
    every joint from there on moves as in the file.
    """
    return assemble(raw_motion(parse_bvh(path), path), options)


def raw_motion(file: BvhFile, path: Path) -> RawMotion:
    """The parsed file as rotations, offsets and one root path, in file units and axes."""
    joints = file.joints
    rot = _rotations(file)
    places = resolve_places(file, rot)
    notes = [*file.notes, *places.notes]
    flat = [
        joints[j].name
        for j in range(1, len(joints))
        if not places.offsets[j].any() and j != places.travel
    ]
    if flat:
        notes.append(zero_length_note(flat))
    return RawMotion(
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


def _rotations(file: BvhFile) -> np.ndarray:
    """`(T, J, 4)` local rotations; each joint's axes in the order of its rotation channels."""
    out = np.zeros((len(file.values), len(file.joints), 4))
    out[..., 0] = 1.0
    radians = torch.tensor(np.radians(file.values))
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
        out[:, [j for j, _ in members]] = euler_to_quat(radians[:, columns], order).numpy()
    return out
