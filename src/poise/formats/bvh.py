"""BVH files as clips, and clips as BVH in the hierarchy, names, channels and unit they came with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.formats.bvh_file import POSITIONS, BvhFile, parse_bvh
from poise.formats.guess import UPS, few_degrees_note
from poise.formats.raw import BLOCK, RawMotion, ReadOptions, assemble, quats_from_z_up, vectors_from_z_up
from poise.formats.root_joint import RIGID_SHARE, Carried, Restored, carried, restored, size_of, text_of
from poise.formats.text import listed, write_whole
from poise.motion.clip import Clip
from poise.motion.rotations import (
    euler_to_quat,
    forward_kinematics,
    quat_angle,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inv,
    quat_to_euler,
)
from poise.motion.skeleton import Channel, Skeleton


def read_bvh(path: Path, options: ReadOptions) -> Clip:
    """A BVH clip.

    A joint's position channels replace its OFFSET, the root's too (LAFAN1 writes the first
    position into both). Where a joint below the root carries the body (Bandai: Hips, Unreal: pelvis),
    its travel becomes the clip's root path and its offset zero, so that every joint from there on moves
    as in the file, see `root_joint.carried`.
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
        columns = np.array([c for _, c in members])
        for at in range(0, len(out), BLOCK):
            radians = np.radians(file.values[at : at + BLOCK])
            turned = euler_to_quat(radians[:, columns], order)
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
    pos, quat = [root_pos], [rot[:, 0]]
    found: list[int] = []
    for j, up in enumerate(parents):
        if up < 0:
            continue
        places = moves.get(j)
        local = np.tile(offsets[j], (len(rot), 1)) if places is None else places
        if places is not None and _stray(places) > tolerance:
            inside = quat_rotate_inv(quat[up], places - pos[up])
            if _stray(inside) < 0.5 * _stray(places):
                found.append(j)
                moves[j], local = inside, inside
        pos.append(pos[up] + quat_rotate(quat[up], local))
        quat.append(quat_mul(quat[up], rot[:, j]))
    return found


def _stray(path: np.ndarray) -> float:
    return float(np.linalg.norm(path - np.median(path, axis=0), axis=-1).max())


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
        raise PoiseError(
            f"the rotation order must name X, Y and Z once each, got '{order}'", code="bad-axis-order"
        )
    source = clip.skeleton.source
    own = source.format == "bvh" and len(source.channels) == len(clip.skeleton)
    unit = unit_m if unit_m is not None else (source.unit_m if own else 0.01)
    axis = (up_axis or (source.up_axis if own else "Y")).upper()
    if not (np.isfinite(unit) and unit > 0):
        raise PoiseError(f"the unit must be above 0 metres, got {unit}", code="out-of-range")
    if axis not in UPS:
        raise PoiseError(
            f"the up axis must be one of {', '.join(UPS)}, got '{axis}'", code="unknown-axis"
        )
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
            made = np.broadcast_to(euler_to_quat(_angles_write(rot[:, j], turns), turns), (len(rot), 4))
            lost = quat_angle(quat_mul(quat_conj(made), rot[:, j])).max()
            if lost > _LOST_ANGLE:
                names = tuple(c for c in names if c in POSITIONS) + full
        if j == 0 and moving and not any(c in POSITIONS for c in names):
            names = POSITIONS + names
        out.append(names)
    return out


def _angles_write(rot: np.ndarray, turns: str) -> np.ndarray:
    """`(T, len(turns))` rad: Euler angles about the given axes, the others dropped, continuous."""
    order = turns + "".join(c for c in "XYZ" if c not in turns)
    angles = quat_to_euler(rot, order)[:, : len(turns)]
    return np.unwrap(angles, axis=0)


def _places(
    skeleton: Skeleton,
    offsets: np.ndarray,
    root_pos: np.ndarray,
    rot: np.ndarray,
    kept: dict[str, np.ndarray],
) -> tuple[dict[int, np.ndarray], np.ndarray]:
    """`(T, 3)` position channels of the root, of the joint that carries the travel, and of joints
    with channels that hold world positions; and `(J, 3)` offsets of the others."""
    back = restored(skeleton, offsets, root_pos, rot) if kept else Restored({0: root_pos}, offsets)
    world = kept.get("world_positions", np.zeros(0)).astype(int)
    pos, _ = forward_kinematics(skeleton.parents, offsets, root_pos, rot)
    return {int(j): pos[:, int(j)] for j in world} | back.paths, back.offsets


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
        angles = np.degrees(_angles_write(rot[:, j], turns)) if turns else np.zeros((len(rot), 0))
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
