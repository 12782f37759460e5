"""Forward kinematics of a tree of joints."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from poise.spatial.rotations import quat_mul, quat_rotate


def forward_kinematics(
    parents: Sequence[int], offsets: Tensor, root_pos: Tensor, rot: Tensor
) -> tuple[Tensor, Tensor]:
    """World positions and rotations of every joint.

    Args:
        parents: parent index per joint, -1 for the root; parents come before children.
        offsets: `(J, 3)` m, the joint's place in its parent's frame (the root's is ignored).
        root_pos: `(..., 3)` m, world.
        rot: `(..., J, 4)` wxyz, local to the parent; the root's is the world rotation.

    Returns:
        positions `(..., J, 3)` m and rotations `(..., J, 4)` wxyz, both world.
    """
    pos: list[Tensor] = []
    quat: list[Tensor] = []
    for j, parent in enumerate(parents):
        if parent < 0:
            pos.append(root_pos)
            quat.append(rot[..., j, :])
        else:
            pos.append(pos[parent] + quat_rotate(quat[parent], offsets[j].expand_as(root_pos)))
            quat.append(quat_mul(quat[parent], rot[..., j, :]))
    return torch.stack(pos, -2), torch.stack(quat, -2)
