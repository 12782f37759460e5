"""Motions as Kimodo writes them: global places and turns of each joint, metres, Y up."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.numpy.arrays import numeric, refuse_bad, require
from poise.motion.io.numpy.smpl_table import LAYOUTS
from poise.motion.io.raw import RawMotion, ReadOptions, assemble
from poise.motion.skeleton import Channel
from poise.spatial import matrix_to_quat

_FPS = 30.0
_SIDES = ("Left", "Right")
_TRUNK = (
    *(("Hips", ""), ("Spine1", "Hips"), ("Spine2", "Spine1"), ("Chest", "Spine2"), ("Neck1", "Chest")),
    *(("Neck2", "Neck1"), ("Head", "Neck2"), ("HeadEnd", "Head"), ("Jaw", "Head")),
    *(("LeftEye", "Head"), ("RightEye", "Head")),
)
_FINGERS = ("Index", "Middle", "Ring", "Pinky")
_Rows = tuple[tuple[str, str], ...]


def _chain(*names: str) -> _Rows:
    """Each joint with the one before as its parent; the first is the parent of the second alone."""
    return tuple(zip(names[1:], names[:-1], strict=True))


def _arm(side: str) -> _Rows:
    return _chain("Chest", *(f"{side}{part}" for part in ("Shoulder", "Arm", "ForeArm", "Hand")))


def _fingers(side: str) -> _Rows:
    hand = f"{side}Hand"
    out = _chain(hand, *(f"{hand}Thumb{k}" for k in ("1", "2", "3", "End")))
    for finger in _FINGERS:
        out += _chain(hand, *(f"{hand}{finger}{k}" for k in ("1", "2", "3", "4", "End")))
    return out


def _leg(side: str, *end: str) -> _Rows:
    return _chain("Hips", *(f"{side}{part}" for part in ("Leg", "Shin", "Foot", "ToeBase", *end)))


def _few(side: str) -> _Rows:
    hand = f"{side}Hand"
    return ((f"{hand}ThumbEnd", hand), (f"{hand}MiddleEnd", hand))


def _soma(full: bool) -> _Rows:
    rows = _TRUNK if full else tuple(r for r in _TRUNK if r[0] != "HeadEnd")
    for side in _SIDES:
        rows += _arm(side) + (_fingers(side) if full else _few(side))
    for side in _SIDES:
        rows += _leg(side, "ToeEnd") if full else _leg(side)
    return rows


def _skeletons() -> dict[int, tuple[tuple[str, ...], tuple[int, ...]]]:
    out: dict[int, tuple[tuple[str, ...], tuple[int, ...]]] = {}
    for rows in (_soma(True), _soma(False)):
        names = tuple(n for n, _ in rows)
        out[len(names)] = names, tuple(names.index(p) if p else -1 for _, p in rows)
    body = LAYOUTS[0]
    return out | {len(body.names): (body.names, body.parents)}


SKELETONS = _skeletons()
"""Names and parents by the number of joints: SOMA with 77 or 30, the body of SMPL-X with 22."""
ROBOT = 34
"""Joints of Kimodo's robot."""


def is_kimodo(data: Mapping[str, Any]) -> bool:
    """Whether named arrays are a motion of Kimodo."""
    return "posed_joints" in data and "global_rot_mats" in data


def read_kimodo(data: Mapping[str, Any], path: Path, options: ReadOptions) -> Clip:
    """A clip from `posed_joints (T, J, 3)` m and `global_rot_mats (T, J, 3, 3)`, at 30 frames a second.

    Bones are the medians of what the joints' places tell.

    Raises:
        PoiseError: a robot's motion, another number of joints, arrays that do not fit together.
    """
    require(data, ("posed_joints", "global_rot_mats"), path, "a motion of Kimodo")
    pos = numeric(data, "posed_joints", (None, None, 3), path)
    count = pos.shape[1]
    if count == ROBOT:
        raise PoiseError("it is the motion of a robot (G1)", path, "Give a motion of SOMA or SMPL-X")
    if count not in SKELETONS:
        known = ", ".join(str(n) for n in sorted(SKELETONS))
        raise PoiseError(f"a motion of Kimodo with {count} joints is not known", path, f"Known: {known}")
    names, parents = SKELETONS[count]
    turns = numeric(data, "global_rot_mats", (len(pos), count, 3, 3), path)
    refuse_bad(pos, "the place", path, names)
    refuse_bad(turns.reshape(len(pos), count, 9), "the rotation", path, names)
    local, offsets = turns.copy(), np.zeros((count, 3))
    for j, p in enumerate(parents):
        if p < 0:
            continue
        back = turns[:, p].transpose(0, 2, 1)
        local[:, j] = back @ turns[:, j]
        bone = np.einsum("tab,tb->ta", back, pos[:, j] - pos[:, p])
        offsets[j] = np.median(bone, 0) if len(bone) else 0.0
    notes = () if options.fps else ("The file states no frame rate: 30 taken, as Kimodo has it",)
    raw = RawMotion(
        format="kimodo",
        path=path,
        names=names,
        parents=parents,
        offsets=offsets,
        ends=(),
        root_pos=pos[:, 0],
        rot=matrix_to_quat(torch.tensor(local)).numpy(),
        fps=options.fps or _FPS,
        channels=(Channel(order=("axis-angle",)),) * count,
        unit_m=1.0,
        up_axis="Y",
        notes=notes,
    )
    return assemble(raw, options)
