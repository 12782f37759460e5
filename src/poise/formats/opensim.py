"""Joint angles of OpenSim's full-body models: `.mot` files and the npz of LocoMuJoCo.

These models share their coordinates (`pelvis_tilt`, `hip_flexion_r`, ...) but the files hold no
bones: a stated default body of 1.70 m takes their place, X to the front, Y up, Z to the right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.arrays import numeric, refuse_bad, require
from poise.formats.guess import check_radians, few_degrees
from poise.formats.raw import RawMotion, ReadOptions, assemble, sided, tree_of
from poise.formats.text import CUT_OFF, MAX_VALUE, decode, listed, number_table, read_bytes, shown
from poise.motion.clip import Clip, check_frames
from poise.motion.rotations import axis_angle_to_quat, quat_mul
from poise.motion.skeleton import Channel
from poise.motion.vectors import norm

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_LEGS = ("hip_flexion_r", "hip_flexion_l", "knee_angle_r", "knee_angle_l")
_PELVIS = ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz")
_STANDING_M = 0.94
_SPINE = ("L5_S1", "L4_L5", "L3_L4", "L2_L3", "L1_L2", "L1_T12")

_SIDES = (("r", 1.0), ("l", -1.0))
# Joint, parent, offset (m). "*" stands for a side; Z is mirrored on the left.
_BONES = (
    ("pelvis", None, (0.0, 0.0, 0.0)),
    ("hip_*", "pelvis", (-0.06, -0.07, 0.08)),
    ("knee_*", "hip_*", (0.0, -0.41, 0.0)),
    ("ankle_*", "knee_*", (0.0, -0.41, 0.0)),
    ("toe_*", "ankle_*", (0.13, -0.05, 0.01)),
    ("spine", "pelvis", (-0.10, 0.08, 0.0)),
    ("head", "spine", (0.02, 0.50, 0.0)),
    ("shoulder_*", "spine", (0.0, 0.37, 0.17)),
    ("elbow_*", "shoulder_*", (0.01, -0.29, 0.0)),
    ("wrist_*", "elbow_*", (0.0, -0.25, 0.01)),
)
_TIPS = (("toe_*", (0.07, 0.0, 0.0)), ("head", (0.0, 0.18, 0.0)), ("wrist_*", (0.0, -0.17, 0.0)))
# Turns of a joint from its parent's frame inwards: axis on the right side, then the coordinates that
# add up to the angle. On the left, turns about X and Y are mirrored. Of two lists the first that the
# file has is taken.
_Turn = tuple[tuple[float, float, float], tuple[str, ...]]
_TURNS: dict[str, tuple[tuple[_Turn, ...], ...]] = {
    "pelvis": (((_Z, ("pelvis_tilt",)), (_X, ("pelvis_list",)), (_Y, ("pelvis_rotation",))),),
    "hip_*": (((_Z, ("hip_flexion_*",)), (_X, ("hip_adduction_*",)), (_Y, ("hip_rotation_*",))),),
    "knee_*": (((_Z, ("knee_angle_*",)),),),
    "ankle_*": (((_Z, ("ankle_angle_*",)), ((0.79, 0.60, -0.12), ("subtalar_angle_*",))),),
    "toe_*": ((((-0.58, 0.0, 0.81), ("mtp_angle_*",)),),),
    "spine": (
        ((_Z, ("lumbar_extension",)), (_X, ("lumbar_bending",)), (_Y, ("lumbar_rotation",))),
        (
            (_Z, tuple(f"{s}_Flex_Ext" for s in _SPINE)),
            (_X, tuple(f"{s}_Lat_Bending" for s in _SPINE)),
            (_Y, tuple(f"{s}_axial_rotation" for s in _SPINE)),
        ),
    ),
    "head": (((_Z, ("neck_flexion",)), (_X, ("neck_bending",)), (_Y, ("neck_rotation",))),),
    "shoulder_*": (
        ((_Z, ("arm_flex_*",)), (_X, ("arm_add_*",)), (_Y, ("arm_rot_*",))),
        (
            (_Y, ("sh_plane_elev_*",)),
            ((-1.0, 0.0, 0.0), ("sh_elev_*",)),
            (_Y, ("sh_axial_rot_*",)),
        ),
    ),
    "elbow_*": ((((0.226, 0.022, 0.974), ("elbow_flex_*",)), (_Y, ("pro_sup_*",))),),
    "wrist_*": (((_Z, ("wrist_flex_*",)), (_X, ("wrist_dev_*",))),),
}


def is_opensim(keys: Mapping[str, Any] | Sequence[str]) -> bool:
    """Whether coordinates of these names (LocoMuJoCo: `q_` before each) turn an OpenSim body."""
    return all(k in keys or f"q_{k}" in keys for k in _LEGS)


def looks_like_mot(head: bytes) -> bool:
    """Whether a file's first bytes are an OpenSim table with the coordinates of legs."""
    return b"endheader" in head.lower() and all(k.encode() in head for k in _LEGS)


def read_mot(path: Path, options: ReadOptions) -> Clip:
    """A clip from an OpenSim `.mot`: joint angles in degrees or radians as its header says.

    Raises:
        PoiseError: one sentence with the line and what to do.
    """
    lines = read_bytes(path).splitlines()
    end = next((i for i, line in enumerate(lines) if line.strip().lower() == b"endheader"), len(lines))
    if end + 1 >= len(lines):
        raise PoiseError("the file ends in its header", path, CUT_OFF, code="file-cut-off")
    degrees = any(x.strip().lower().replace(b" ", b"") == b"indegrees=yes" for x in lines[:end])
    names = decode(lines[end + 1], path, end + 2).split()
    table = number_table(lines, end + 2, len(names), path)
    columns = dict(zip(names, table.T, strict=True))
    require(columns, ("time", *_PELVIS), path, "this OpenSim motion")
    check_frames(len(table), path)
    if not (np.abs(columns["time"]) <= MAX_VALUE).all():
        raise PoiseError(
            "its times are no usable numbers", path, "Write them as seconds", code="times-unusable"
        )
    steps = np.diff(columns["time"])
    step = float(steps.mean())
    if not (step > 0 and np.abs(steps / step - 1).max() < 0.05):
        raise PoiseError(
            "its times are not evenly spaced", path, "Resample it in OpenSim", code="times-uneven"
        )
    turns = {k: columns[k] for k in _coordinates() if k in columns}
    _check_unit(turns, degrees, path)
    for name in turns:
        if degrees and name not in _PELVIS[3:]:
            turns[name] = np.radians(turns[name])
    return _clip(turns, 1.0 / step, path, options, [])


def read_loco(data: Mapping[str, Any], path: Path, options: ReadOptions) -> Clip:
    """A clip from LocoMuJoCo's arrays `q_NAME (T,)` rad or m of its full humanoid.

    The frame rate follows from the velocities `dq_NAME`; pelvis heights that are relative to the
    model's standing height are put at that of the default body.
    """
    prefix = "q_" if f"q_{_LEGS[0]}" in data else ""
    require(data, [prefix + k for k in _PELVIS], path, "this OpenSim motion")
    turns = {k: numeric(data, prefix + k, (None,), path) for k in _coordinates() if prefix + k in data}
    hint = "Convert the angles to radians"
    check_radians(_joint_angles(turns), "LocoMuJoCo's arrays hold", path, hint)
    notes: list[str] = []
    fps = options.fps or _rate(data, turns, path, notes)
    if np.median(turns["pelvis_ty"]) < 0.4 * _STANDING_M:
        turns["pelvis_ty"] = turns["pelvis_ty"] + _STANDING_M
        notes.append(
            f"The pelvis heights are relative: the default body's standing height of {_STANDING_M} m "
            "was added"
        )
    # Its left hip turns about the axes of the right one: only so do the feet stand still in stance.
    for name in ("hip_adduction_l", "hip_rotation_l"):
        if name in turns:
            turns[name] = -turns[name]
    return _clip(turns, fps, path, options, notes)


def _joint_angles(turns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The coordinates that turn one bone against another; a pelvis may turn round and round."""
    return {name: values for name, values in turns.items() if name not in _PELVIS}


def _check_unit(turns: Mapping[str, np.ndarray], degrees: bool, path: Path) -> None:
    """Refuses angles that cannot be in the unit that the header states."""
    angles = _joint_angles(turns)
    if not degrees:
        stated = "inDegrees=no in the header states"
        check_radians(angles, stated, path, "Write inDegrees=yes in the header, or convert the table")
        return
    found = few_degrees(angles)
    if found is not None:
        raise PoiseError(
            f"no joint turns by more than a few degrees ('{found[0]}' most, to {found[1]:.3g}), the "
            "unit that inDegrees=yes in the header states: the angles seem to be radians",
            path,
            "Write inDegrees=no in the header, or convert the table",
            code="radians-as-degrees",
        )


def _coordinates() -> list[str]:
    """The names of all coordinates that are used."""
    turning = [c for lists in _TURNS.values() for steps in lists for _, names in steps for c in names]
    return sorted({*_PELVIS, *(_side(c, s) for c in turning for s in "rl")})


def _rate(
    data: Mapping[str, Any], turns: Mapping[str, np.ndarray], path: Path, notes: list[str]
) -> float:
    """Frames per second from positions and velocities: q[t+1] - q[t] = dq / fps.

    The median over all frames of the hips' angles, in whole frames per second: velocities are
    smoothed, so that their mean is a little off.
    """
    ratios = []
    for name in ("hip_flexion_r", "hip_flexion_l"):
        if f"dq_{name}" in data:
            speed = numeric(data, f"dq_{name}", turns[name].shape, path)
            step, middle = np.diff(turns[name]), 0.5 * (speed[1:] + speed[:-1])
            ratios.append(middle / np.where(step == 0, np.nan, step))
    found = np.concatenate(ratios) if ratios else np.zeros(0)
    found = found[np.isfinite(found)]
    fps = float(np.round(np.median(found))) if len(found) else 0.0
    if fps > 0:
        notes.append(f"The frame rate, {fps:g} frames per second, follows from the velocities")
        return fps
    raise PoiseError("the file states no frame rate", path, "State it with --fps F", code="rate-missing")


def _clip(
    turns: Mapping[str, np.ndarray], fps: float, path: Path, options: ReadOptions, notes: list[str]
) -> Clip:
    frames = {len(v) for v in turns.values()}
    if len(frames) != 1:
        raise PoiseError(
            f"its coordinates have different lengths: {listed(sorted(frames))}",
            path,
            code="length-differs",
        )
    for name, values in turns.items():
        refuse_bad(values, f"coordinate {shown(name)}", path)
    names, parents, offsets = tree_of(sided(_BONES, _SIDES, 2))
    tips = sided(((n, None, v) for n, v in _TIPS), _SIDES, 2)
    notes.append("The file holds no bones: those of Poise's default body of 1.70 m were taken")
    raw = RawMotion(
        format="opensim",
        path=path,
        names=names,
        parents=parents,
        offsets=offsets,
        ends=tuple((names.index(n), tip) for n, _, tip in tips),
        root_pos=np.stack([turns[f"pelvis_t{c}"] for c in "xyz"], -1),
        rot=np.stack([_turned(n, turns) for n in names], 1),
        fps=fps,
        channels=(Channel(order=("coordinates",)),) * len(names),
        unit_m=1.0,
        up_axis="Y",
        notes=tuple(notes),
    )
    return assemble(raw, options)


def _side(name: str, side: str) -> str:
    return name.replace("*", side)


def _turned(joint: str, turns: Mapping[str, np.ndarray]) -> np.ndarray:
    """`(T, 4)` wxyz, the joint's rotation: its turns one after the other, from the parent inwards."""
    side = joint[-1] if joint not in _TURNS else ""
    lists = _TURNS[joint if not side else f"{joint[:-1]}*"]
    chosen = next((x for x in lists if any(_side(n, side) in turns for _, ns in x for n in ns)), ())
    count = len(turns["pelvis_tilt"])
    out = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    for axis, names in chosen:
        angle = sum((turns[n] for n in (_side(n, side) for n in names) if n in turns), np.zeros(count))
        if side == "l":
            # Mirroring at the plane of X and Y turns the sense of rotations about X and Y.
            axis = (-axis[0], -axis[1], axis[2])
        if joint.startswith("knee") and np.median(angle) > 0:
            # Newer models count the bent knee as positive; the shin always goes back.
            angle = -angle
        unit = np.asarray(axis, dtype=float)
        turn = axis_angle_to_quat(np.broadcast_to(unit / norm(unit), (count, 3)), angle)
        out = quat_mul(out, turn)
    return out
