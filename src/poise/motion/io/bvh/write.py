"""Clips as BVH files, in the hierarchy, names, channels, unit and axes they came with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.bvh.file import POSITIONS
from poise.motion.io.guess import UPS
from poise.motion.io.raw import quats_from_z_up, vectors_from_z_up
from poise.motion.io.text import write_whole
from poise.motion.io.travel import Restored, restored
from poise.motion.skeleton import Skeleton
from poise.spatial import (
    euler_to_quat,
    forward_kinematics,
    quat_angle,
    quat_conj,
    quat_mul,
    quat_to_euler,
)

_LOST_ANGLE = np.radians(0.005)


def write_bvh(
    clip: Clip,
    path: str | Path,
    unit_m: float | None = None,
    up_axis: str | None = None,
    order: str = "ZXY",
) -> None:
    """Writes a clip as BVH.

    A clip that came from BVH keeps its hierarchy, names, channel orders, unit, vertical, frame
    time and the joint that carries the travel; any other gets centimetres, Y up and rotation
    channels in `order`. The file appears whole or not at all.

    Args:
        unit_m: metres per file unit. up_axis: one of `UPS`. order: three different axes.

    Raises:
        PoiseError: bad arguments, or the folder is missing or cannot be written to.
    """
    path = Path(path)
    order = order.upper()
    if sorted(order) != ["X", "Y", "Z"]:
        raise PoiseError(f"the rotation order must name X, Y and Z once each, got '{order}'")
    source = clip.skeleton.source
    own = source.format == "bvh" and len(source.channels) == len(clip.skeleton)
    unit = unit_m if unit_m is not None else (source.unit_m if own else 0.01)
    axis = (up_axis or (source.up_axis if own else "Y")).upper()
    if not (np.isfinite(unit) and unit > 0):
        raise PoiseError(f"the unit must be above 0 metres, got {unit}")
    if axis not in UPS:
        raise PoiseError(f"the up axis must be one of {', '.join(UPS)}, got '{axis}'")
    rot = quats_from_z_up(clip.rot, axis)
    offsets = vectors_from_z_up(clip.skeleton.offsets, axis) / unit
    root_pos = vectors_from_z_up(clip.root_pos, axis) / unit
    kept = {k: np.array([float(x) for x in v.split()]) for k, v in source.extra} if own else {}
    if own and (unit != source.unit_m or axis != source.up_axis):
        # Remembered file values hold in the file's own unit and axes only.
        kept = {}
    places, stand = _places(clip.skeleton, offsets, root_pos, rot, kept)
    moving = bool(np.ptp(places[0], axis=0).max() > 0)
    channels = _channels(clip.skeleton, rot, moving, own, order)
    if not any(c in POSITIONS for c in channels[0]):
        # Without position channels the root stands at its OFFSET.
        kept["offset:0"] = places[0][0]
    lines, written = _hierarchy(clip.skeleton, stand, channels, kept, axis, unit, own)
    step = 1.0 / clip.fps
    if own and source.frame_time and abs(source.frame_time * clip.fps - 1.0) < 1e-9:
        step = source.frame_time
    lines += ["MOTION", f"Frames: {clip.frames}", f"Frame Time: {step!r}"]
    lines += _rows(rot, channels, places, stand, written)
    write_whole(path, "\n".join(lines) + "\n")


def _channels(
    skeleton: Skeleton, rot: np.ndarray, moving: bool, own: bool, order: str
) -> list[tuple[str, ...]]:
    """Channel names per joint; a joint that turns beyond its source's channels gets all three,
    and a root that moves gets position channels."""
    full = tuple(f"{c}rotation" for c in order)
    if not own:
        return [POSITIONS + full] + [full] * (len(skeleton) - 1)
    out = []
    for j, channel in enumerate(skeleton.source.channels):
        names = channel.order
        turns = "".join(c[0] for c in names if c.endswith("rotation"))
        if len(turns) < 3:
            made = euler_to_quat(_angles(rot[:, j], turns), turns).expand(len(rot), 4)
            lost = quat_angle(quat_mul(quat_conj(made), torch.tensor(rot[:, j]))).max()
            if lost > _LOST_ANGLE:
                names = tuple(c for c in names if c in POSITIONS) + full
        if j == 0 and moving and not any(c in POSITIONS for c in names):
            names = POSITIONS + names
        out.append(names)
    return out


def _angles(rot: np.ndarray, turns: str) -> torch.Tensor:
    """`(T, len(turns))` rad: Euler angles about the given axes, the others dropped, continuous."""
    order = turns + "".join(c for c in "XYZ" if c not in turns)
    angles = quat_to_euler(torch.tensor(rot), order)[:, : len(turns)].numpy()
    return torch.tensor(np.unwrap(angles, axis=0))


def _places(
    skeleton: Skeleton,
    offsets: np.ndarray,
    root_pos: np.ndarray,
    rot: np.ndarray,
    kept: dict[str, np.ndarray],
) -> tuple[dict[int, np.ndarray], np.ndarray]:
    """`(T, 3)` position channels of the root, of the joint that carries the travel, and of joints
    with channels that hold world positions; and `(J, 3)` offsets of the others."""
    parents, turns, bones = skeleton.parents, torch.tensor(rot), torch.tensor(offsets)
    back = restored(skeleton, offsets, root_pos, rot) if kept else Restored({0: root_pos}, offsets)
    world = kept.get("world_positions", np.zeros(0)).astype(int)
    pos, _ = forward_kinematics(parents, bones, torch.tensor(root_pos), turns)
    return {int(j): pos[:, int(j)].numpy() for j in world} | back.paths, back.offsets


def _hierarchy(
    skeleton: Skeleton,
    offsets: np.ndarray,
    channels: list[tuple[str, ...]],
    kept: dict[str, np.ndarray],
    axis: str,
    unit: float,
    own: bool,
) -> tuple[list[str], list[int]]:
    """The lines of the hierarchy, and the joints in the order in which they stand in it."""
    tips: dict[int, list[np.ndarray]] = {}
    for j, tip in skeleton.ends:
        tips.setdefault(j, []).append(vectors_from_z_up(np.array(tip), axis) / unit)
    lines = ["HIERARCHY"]
    # Depth first from an explicit stack; None closes a brace.
    stack: list[tuple[int | None, int]] = [(0, 0)]
    written: list[int] = []
    while stack:
        j, depth = stack.pop()
        tab = "\t" * depth
        if j is None:
            lines.append(f"{tab}}}")
            continue
        written.append(j)
        offset = kept[f"offset:{j}"] if f"offset:{j}" in kept else offsets[j]
        lines += [f"{tab}{'ROOT' if j == 0 else 'JOINT'} {skeleton.names[j]}", f"{tab}{{"]
        lines.append(f"{tab}\tOFFSET {_numbers(offset)}")
        lines.append(f"{tab}\tCHANNELS {' '.join([str(len(channels[j])), *channels[j]])}")
        children = skeleton.children(j)
        ends = tips.get(j, [] if children or own else [np.zeros(3)])
        for tip in ends:
            lines += [f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET {_numbers(tip)}", f"{tab}\t}}"]
        stack.append((None, depth))
        stack += [(c, depth + 1) for c in reversed(children)]
    return lines, written


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{x + 0.0:.9f}" for x in values.tolist())


def _rows(
    rot: np.ndarray,
    channels: list[tuple[str, ...]],
    places: dict[int, np.ndarray],
    offsets: np.ndarray,
    written: list[int],
) -> list[str]:
    columns: list[np.ndarray] = []
    for j in written:
        names = channels[j]
        turns = "".join(c[0] for c in names if c.endswith("rotation"))
        angles = np.degrees(_angles(rot[:, j], turns).numpy()) if turns else np.zeros((len(rot), 0))
        for name in names:
            if name in POSITIONS:
                i = POSITIONS.index(name)
                columns.append(places[j][:, i] if j in places else np.full(len(rot), offsets[j, i]))
            else:
                columns.append(angles[:, turns.index(name[0])])
    # Rounded first, so that no "-0.000000" is written.
    table = np.round(np.stack(columns, -1), 6) + 0.0
    form = " ".join(["%.6f"] * table.shape[1])
    return [form % tuple(row) for row in table.tolist()]
