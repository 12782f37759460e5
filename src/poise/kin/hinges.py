"""Rotations as chains of hinges, with angles that never jump from one frame to the next."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.kin.branches import euler_path
from poise.spatial import euler_to_quat, quat_between, quat_conj, quat_mul, quat_to_euler


def chain_quat(angles: Tensor, order: str, frame: Tensor) -> Tensor:
    """Rotation `(..., 4)` of a hinge chain: `frame * R_order(angles) * frame^-1`.

    angles: `(..., n)` rad, outermost hinge first. order: axis letters of `frame`, "" to "ZYX".
    """
    return quat_mul(quat_mul(frame, euler_to_quat(angles, order)), quat_conj(frame))


def chain_angles(rot: Tensor, order: str, frame: Tensor, prefer: Tensor | None = None) -> Tensor:
    """Hinge angles `(T, n)` rad of the chain that comes nearest to `rot (T, 4)`, continuous in time.

    Three hinges reproduce any rotation. Of the two Euler branches (a, b, c) and
    (a + pi, pi - b, c + pi) the sequence with the smallest sum of squared steps is found
    (`euler_path`); whole turns are unwrapped, so a pirouette counts up. Two hinges drop the missing
    third angle and one hinge takes the twist about its axis: both exact for rotations that lie in
    the chain. The whole sequence is shifted by full turns to lie nearest `prefer (n)` (default 0).
    """
    local = quat_mul(quat_between(frame, rot), frame)
    if not order:
        return local.new_zeros(*local.shape[:-1], 0)
    if len(order) == 1:
        axis = 1 + "XYZ".index(order)
        raw = 2.0 * torch.atan2(local[:, axis], local[:, 0])
        path = raw.unsqueeze(-1)
    elif len(order) == 2:
        missing = next(c for c in "XYZ" if c not in order)
        path = quat_to_euler(local, order[0] + missing + order[1])[:, [0, 2]]
    else:
        free = through_lock(quat_to_euler(local, order), order).numpy()
        path = torch.tensor(
            euler_path(free[:, None], None if prefer is None else prefer.numpy()[None])[:, 0]
        )
    path = torch.tensor(np.unwrap(path.numpy(), axis=0))
    centre = torch.zeros(len(order), dtype=path.dtype) if prefer is None else prefer
    turns = torch.round((path.median(0).values - centre) / (2 * math.pi))
    return path - turns * 2 * math.pi


def through_lock(angles: Tensor, order: str) -> Tensor:
    """Euler angles `(T, 3)`, the third angle held through frames exactly at gimbal lock.

    There only the sum a +- c is known and `quat_to_euler` sets c to zero, which would be a jump.
    """
    # At b = +-90 degrees R_i(a) R_j(b) R_k(c) = R_i(a +- s c) R_j(b), s the parity of the order.
    locked = (angles[:, 2] == 0.0) & (angles[:, 1].abs() > math.pi / 2 - 1e-6)
    if not bool(locked.any()) or bool(locked.all()):
        return angles
    free = (~locked).nonzero().squeeze(-1)
    at = torch.arange(len(angles))
    # The nearest free frame before, or the first one.
    held = angles[free[(torch.searchsorted(free, at, right=True) - 1).clamp_min(0)], 2]
    parity = 1.0 if order in ("XYZ", "YZX", "ZXY") else -1.0
    first = angles[:, 0] - parity * angles[:, 1].sign() * held
    out = angles.clone()
    out[:, 0] = torch.where(locked, first, angles[:, 0])
    out[:, 2] = torch.where(locked, held, angles[:, 2])
    return out


def within_turns(qpos: np.ndarray, humanoid: Humanoid) -> np.ndarray:
    """`qpos (T, 7 + n)` with each hinge shifted by whole turns as near to its range as can be."""
    middle = humanoid.model.jnt_range[1:].mean(-1)
    turns = np.round((qpos[:, 7:].mean(0) - middle) / (2 * np.pi))
    out = qpos.copy()
    out[:, 7:] -= 2 * np.pi * turns
    return out
