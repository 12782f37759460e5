"""Feet led so that what bears does not travel: the smallest smooth correction of a whole clip.

Both ends p of a sole are moved by a shift s of the foot and a turn psi about the vertical:

    min  sum over frames dt [ sum over ends p  w_p |v_p + s' + psi' z x r_p|^2
                              + A^2 (|s''|^2 + L^2 psi''^2) + B^2 (|s|^2 + L^2 psi^2) ]

v_p is the horizontal velocity of an end, w_p how much it bears, r_p its place from the ankle and L the
length of the sole. B leaves slow drifts of long stances where they are, A lets a swinging foot go back
to its own path without a jerk.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.kin.feet.contact import Sole
from poise.kin.limbs import limb_of, match_positions
from poise.motion import Skeleton
from poise.spatial import axis_angle_to_quat, forward_kinematics, quat_between, quat_mul

#: A (s) and B (1/s) of the module's text.
SMOOTH_S, RETURN_PER_S = 0.006, 0.6
#: See `limbs.soft_reach`: feet that stand are kept in place by legs that may be nearly straight.
_SOFT = 0.003
#: Weight of a frame that must stay as it is; what is left of its correction is set to zero.
_PINNED = 1e8


class Lead(NamedTuple):
    """What is done to a foot: shift `(T, 3)` m of its ankle, turn `(T)` rad about the vertical, tilt
    `(T)` rad that raises its toe, about `axis (T, 3)`, which is level, and roll `(T)` rad about the line
    of the sole, None without any."""

    shift: Tensor
    turn: Tensor
    tilt: Tensor
    axis: Tensor
    roll: Tensor | None = None


def lead(
    sole: Sole,
    weight: np.ndarray,
    fps: float,
    fixed: np.ndarray | None = None,
    vertical: float = 0.0,
    flat: np.ndarray | None = None,
) -> Lead:
    """How a foot must be led; see the module's text.

    Args:
        weight: `(T - 1, 2)`, how much each end bears between frames.
        fixed: `(T)` bool, frames that stay as they are.
        vertical: the heights of the ends are held as well, by a shift and a tilt, with this share of
            `weight`.
        flat: `(T - 1)`, how much the ankle stays as well, above the sole, by a roll of the foot.
    """
    fixed = np.zeros(len(sole.ankle), dtype=bool) if fixed is None else fixed
    ends, ankle = sole.ends.numpy(), sole.ankle.numpy()
    velocity = np.diff(ends, axis=0) * fps
    length = float(np.linalg.norm(ends[0, 1] - ends[0, 0]))
    arm = (ends - ankle[:, None]) / length
    middle = 0.5 * (arm[1:] + arm[:-1])
    way = ends[:, 1, :2] - ends[:, 0, :2]
    way = way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)
    # Unknowns per frame: s_x, s_y, L psi, and the roll about the sole's line times L.
    rows, width = [], 3 if flat is None else 4
    for p in range(2):
        for axis, across in ((0, -middle[:, p, 1]), (1, middle[:, p, 0])):
            unit = np.zeros((len(velocity), 4))
            unit[:, axis], unit[:, 2] = 1.0, across
            unit[:, 3] = middle[:, p, 2] * (way[1:, 1], -way[1:, 0])[axis]
            unit = unit[:, :width]
            rows.append((np.stack((-unit, unit), 1) * fps, -velocity[:, p, axis], weight[:, p]))
    if flat is not None:
        slip = np.diff(ankle, axis=0) * fps
        for axis in range(2):
            unit = np.tile(np.eye(width)[axis], (len(slip), 1))
            rows.append((np.stack((-unit, unit), 1) * fps, -slip[:, axis], flat))
    level = _solve(rows, width, fixed, fps)
    up = np.zeros((len(ankle), 2))
    if vertical:
        # Unknowns per frame: s_z, L theta.
        along = (middle[..., :2] * 0.5 * (way[1:] + way[:-1])[:, None]).sum(-1)
        heights = []
        for p in range(2):
            unit = np.stack((np.ones(len(along)), along[:, p]), -1)
            held = vertical * weight[:, p]
            heights.append((np.stack((-unit, unit), 1) * fps, -velocity[:, p, 2], held))
        up = _solve(heights, 2, fixed, fps)
    shift = np.concatenate((level[:, :2], up[:, :1]), -1)
    axis = np.stack((way[:, 1], -way[:, 0], np.zeros(len(way))), -1)
    turns = (level[:, 2] / length, up[:, 1] / length, axis, *(level[:, 3:] / length).T)
    return Lead(*(torch.tensor(x) for x in (shift, *turns)))


def led(skeleton: Skeleton, rot: Tensor, root: Tensor, leads: Mapping[int, Lead]) -> Tensor:
    """The motion `(T, J, 4)` with the feet (by joint) led, their legs bent to follow, all else kept."""
    pos, quat = forward_kinematics(
        skeleton.parents, torch.tensor(skeleton.offsets, dtype=rot.dtype), root, rot
    )
    goals: dict[int | str, Tensor] = {j: pos[:, j] + one.shift for j, one in leads.items()}
    touched = torch.zeros(len(rot), dtype=torch.bool)
    for one in leads.values():
        touched |= one.shift.any(-1) | (one.turn != 0) | (one.tilt != 0)
        if one.roll is not None:
            touched |= one.roll != 0
    out = match_positions(skeleton, rot, root, goals, soft=_SOFT)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=rot.dtype)
    for joint, one in leads.items():
        # The foot keeps its turn in the world, so its own turn is that of the world seen from it.
        own = quat[:, joint]
        tilt = axis_angle_to_quat(one.axis.to(own.dtype), one.tilt)
        about = quat_mul(axis_angle_to_quat(up, one.turn), tilt)
        if one.roll is not None:
            line = torch.linalg.cross(up.expand_as(one.axis), one.axis.to(own.dtype), dim=-1)
            about = quat_mul(about, axis_angle_to_quat(line, one.roll))
        out[:, joint] = quat_mul(out[:, joint], quat_between(own, quat_mul(about, own)))
    kept = torch.ones(rot.shape[:2], dtype=torch.bool)
    for joint in leads:
        kept[:, list(limb_of(skeleton, joint))] = ~touched[:, None]
    return torch.where(kept[..., None], rot, out)


Rows = tuple[np.ndarray, np.ndarray, np.ndarray]


def _solve(rows: list[Rows], width: int, fixed: np.ndarray, fps: float) -> np.ndarray:
    """`(T, width)` of least squares with the smoothing terms, zero in the frames `fixed`.

    rows: blocks of `(R, m, width)` coefficients at the frames r to r + m - 1 of row r, what each row
    should give, and its weight.
    """
    frames = len(fixed)
    band, rhs = np.zeros((3 * width, width * frames)), np.zeros(width * frames)
    for block in rows:
        _add(band, rhs, *block)
    for unit in np.eye(width):
        if frames > 2:
            bend = np.tile(np.stack((unit, -2 * unit, unit)) * fps**2, (frames - 2, 1, 1))
            _add(band, rhs, bend, np.zeros(frames - 2), np.full(frames - 2, SMOOTH_S**2))
        back = np.where(fixed, _PINNED, RETURN_PER_S**2)
        _add(band, rhs, np.tile(unit, (frames, 1, 1)), np.zeros(frames), back)
    from scipy.linalg import solveh_banded

    x = solveh_banded(band, rhs, lower=True).reshape(frames, width)
    x[fixed] = 0.0
    return x


def _add(
    band: np.ndarray, rhs: np.ndarray, rows: np.ndarray, want: np.ndarray, weight: np.ndarray
) -> None:
    """Adds `weight |rows x - want|^2` to the normal equations in lower banded form."""
    count, m, width = rows.shape
    flat = rows.reshape(count, width * m)
    at = width * np.arange(count)
    for i in range(width * m):
        np.add.at(rhs, at + i, weight * flat[:, i] * want)
        for j in range(i + 1):
            np.add.at(band[i - j], at + j, weight * flat[:, i] * flat[:, j])
