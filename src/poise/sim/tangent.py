"""Differences of positions in the coordinates of velocities, for many worlds at once."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.spatial import quat_conj, quat_mul, quat_to_rotvec, rotvec_to_quat


def difference(to: Tensor, since: Tensor) -> Tensor:
    """`(N, nv)` from the positions `since (N, nq)` to `to`, as MuJoCo's `mj_differentiatePos` in 1 s.

    World metres, then radians in the axes of `since`, then hinges; a free root comes first.
    """
    turn = quat_to_rotvec(quat_mul(quat_conj(since[:, 3:7]), to[:, 3:7]))
    return torch.cat((to[:, :3] - since[:, :3], turn, to[:, 7:] - since[:, 7:]), 1)


def displaced(qpos: Tensor, by: Tensor) -> Tensor:
    """The positions `(N, nq)` that lie `by (N, nv)` from `qpos`: the inverse of `difference`."""
    turned = quat_mul(qpos[:, 3:7], rotvec_to_quat(by[:, 3:6]))
    return torch.cat((qpos[:, :3] + by[:, :3], turned, qpos[:, 7:] + by[:, 6:]), 1)
