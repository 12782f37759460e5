"""Forward kinematics of a tree of joints."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor

from poise.spatial.rotations import quat_mul, quat_rotate

#: Joints from which on ancestors are joined in steps that double, not one by one.
_MANY = 300


def forward_kinematics(
    parents: Sequence[int], offsets: Tensor, root_pos: Tensor, rot: Tensor
) -> tuple[Tensor, Tensor]:
    """World positions and rotations of every joint.

    Args:
        parents: parent index per joint, -1 for the root; parents come before children.
        offsets: `(J, 3)` m, the joint's place in its parent's frame (the root's is ignored); it
            may have leading dimensions that broadcast with those of `root_pos`.
        root_pos: `(..., 3)` m, world.
        rot: `(..., J, 4)` wxyz, local to the parent; the root's is the world rotation.

    Returns:
        positions `(..., J, 3)` m and rotations `(..., J, 4)` wxyz, both world.
    """
    if len(parents) > _MANY:
        return _by_doubling(parents, offsets, root_pos, rot)
    pos: list[Tensor] = []
    quat: list[Tensor] = []
    for j, parent in enumerate(parents):
        if parent < 0:
            pos.append(root_pos)
            quat.append(rot[..., j, :])
        else:
            pos.append(pos[parent] + quat_rotate(quat[parent], offsets[..., j, :].expand_as(root_pos)))
            quat.append(quat_mul(quat[parent], rot[..., j, :]))
    return torch.stack(pos, -2), torch.stack(quat, -2)


def _by_doubling(
    parents: Sequence[int], offsets: Tensor, root_pos: Tensor, rot: Tensor
) -> tuple[Tensor, Tensor]:
    """As `forward_kinematics`, in log2(depth) steps over all joints: each step joins what lies between a
    joint and its ancestor of 1, 2, 4, ... generations above with what lies above that one."""
    up = torch.tensor(list(parents))
    first = (up < 0).unsqueeze(-1)
    pos = torch.where(first, root_pos.unsqueeze(-2), offsets.expand(*rot.shape[:-1], 3))
    quat = rot
    while (here := (up >= 0).nonzero().squeeze(-1)).numel():
        above = up[here]
        turn = quat[..., above, :]
        new = pos[..., above, :] + quat_rotate(turn, pos[..., here, :])
        pos, quat = (
            pos.index_copy(-2, here, new),
            quat.index_copy(-2, here, quat_mul(turn, quat[..., here, :])),
        )
        up = torch.where(up >= 0, up[up.clamp(min=0)], up)
    return pos, quat


@cache
def _levels(parents: tuple[int, ...]) -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
    """Joints by depth, with the place of each one's parent in the level above; then the way back."""
    depth = [0] * len(parents)
    for j, parent in enumerate(parents):
        depth[j] = 0 if parent < 0 else depth[parent] + 1
    rows = [tuple(j for j, d in enumerate(depth) if d == k) for k in range(max(depth) + 1)]
    return tuple(
        (row, tuple(rows[k - 1].index(parents[j]) if k else 0 for j in row))
        for k, row in enumerate(rows)
    )


def matrix_kinematics(
    parents: Sequence[int], offsets: Tensor, root_pos: Tensor, rot: Tensor
) -> tuple[Tensor, Tensor]:
    """World positions `(..., J, 3)` and rotation matrices `(..., J, 3, 3)`, one product per level.

    As `forward_kinematics`, but `rot (..., J, 3, 3)` are matrices and joints of one depth are computed
    together, which pays for batches that are learned from.

    Args:
        offsets: `(J, 3)` m, or with leading dimensions that broadcast with those of `rot`.
    """
    levels = _levels(tuple(parents))
    pos, mats = [root_pos.unsqueeze(-2)], [rot[..., :1, :, :]]
    for joints, above in levels[1:]:
        up, down = list(above), list(joints)
        turn = mats[-1][..., up, :, :]
        step = offsets[..., down, :].unsqueeze(-1)
        pos.append(pos[-1][..., up, :] + (turn @ step).squeeze(-1))
        mats.append(turn @ rot[..., down, :, :])
    order = [j for joints, _ in levels for j in joints]
    back = [order.index(j) for j in range(len(order))]
    return torch.cat(pos, -2)[..., back, :], torch.cat(mats, -3)[..., back, :, :]
