"""Motion as rows of numbers that know no place and no heading, and back.

A frame is (v, w, z, r, q): the root's horizontal velocity in its own heading, m/s (2), the speed of its
heading, rad/s (1), its height, m (1), its turn without heading, 6D (6), and the hinge angles, rad (n).
Velocities are those from the frame before.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poise.spatial import (
    axis_angle_to_quat,
    heading_quat,
    matrix_to_quat,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_to_sixd,
    sixd_to_matrix,
    unwrap_quats,
)

#: Numbers of a frame beside the hinges'.
ROOT = 10


def features_of(qpos: Tensor, fps: float) -> Tensor:
    """Frames `(T, 10 + n)` of coordinates `(T, 7 + n)`; the first one moves as the second does."""
    root, turn = qpos[:, :3], qpos[:, 3:7]
    heading = heading_quat(turn)
    step = quat_rotate(quat_conj(heading[1:]), torch.diff(root, dim=0)) * fps
    move = quat_mul(quat_conj(heading[:-1]), heading[1:])
    speed = 2 * torch.atan2(move[:, 3:], move[:, :1])
    speed = (torch.remainder(speed + torch.pi, 2 * torch.pi) - torch.pi) * fps
    moving = torch.cat((step[:, :2], speed), -1)
    moving = torch.cat((moving[:1], moving))
    tilt = quat_to_sixd(quat_mul(quat_conj(heading), turn))
    return torch.cat((moving, root[:, 2:], tilt, qpos[:, 7:]), -1)


def past_features(qpos: Tensor, fps: float) -> Tensor:
    """The same of several pasts `(N, T, 7 + n)`."""
    return torch.stack([features_of(q, fps) for q in qpos])


def coordinates(frames: Tensor, last: Tensor, fps: float) -> Tensor:
    """Coordinates `(N, T, 7 + n)` of frames `(N, T, 10 + n)` that follow `last (N, 7 + n)`."""
    heading, at = heading_quat(last[:, 3:7]), last[:, :3]
    up = torch.tensor([0.0, 0.0, 1.0]).to(frames)
    tilt = matrix_to_quat(sixd_to_matrix(frames[..., 4:ROOT]))
    out: list[Tensor] = []
    for k in range(frames.shape[1]):
        f = frames[:, k]
        heading = quat_mul(heading, axis_angle_to_quat(up.expand(len(f), 3), f[:, 2] / fps))
        flat = torch.cat((f[:, :2], torch.zeros_like(f[:, :1])), -1)
        at = at + quat_rotate(heading, flat) / fps
        at = torch.cat((at[:, :2], f[:, 3:4]), -1)
        out.append(torch.cat((at, quat_mul(heading, tilt[:, k]), f[:, ROOT:]), -1))
    made = torch.stack(out, 1)
    turns = torch.cat((last[:, None, 3:7], made[..., 3:7]), 1)
    turns = torch.stack([unwrap_quats(q) for q in turns])[:, 1:]
    return torch.cat((made[..., :3], turns, made[..., 7:]), -1)
