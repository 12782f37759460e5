"""Motions turned about the vertical: coordinates that begin with a root's place and rotation."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from poise.spatial.rotations import heading_quat, quat_mul, quat_rotate


def turned(qpos: Tensor, angle: float, about: Tensor, onto: Tensor) -> Tensor:
    """Frames turned about Z through the place `about (2)`, which moves to `onto (2)`."""
    turn, out = yaw_quat(torch.full((len(qpos),), angle, dtype=torch.float64)), qpos.clone()
    out[:, :2] -= about
    out[:, :3] = quat_rotate(turn, out[:, :3])
    out[:, :2] += onto
    out[:, 3:7] = quat_mul(turn, qpos[:, 3:7])
    return out


def facing(pose: Tensor, heading: float) -> Tensor:
    """A pose that stands at the origin and faces so."""
    origin = torch.zeros(2, dtype=torch.float64)
    return turned(pose[None], heading - heading_angle(pose[3:7]), pose[:2], origin)[0]


def yaw_quat(angle: Tensor) -> Tensor:
    """`(..., 4)` wxyz float64, turns about Z by `angle (...)` rad."""
    half, none = 0.5 * angle.double(), torch.zeros_like(angle, dtype=torch.float64)
    return torch.stack((half.cos(), none, none, half.sin()), -1)


def heading_angle(quat: Tensor) -> float:
    """rad about Z of a rotation, or the mean one of several."""
    h = heading_quat(quat.reshape(-1, 4))
    angle = 2 * torch.atan2(h[:, 3], h[:, 0])
    return math.atan2(float(angle.sin().mean()), float(angle.cos().mean()))
