"""Forward kinematics against a recursion with SciPy."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from poise.motion.rotations import forward_kinematics, normalize, quat_mul, quat_rotate

PARENTS = (-1, 0, 1, 1, 3, 0)


def naive(offsets: np.ndarray, root: np.ndarray, rot: np.ndarray, j: int) -> tuple[np.ndarray, Rotation]:
    own = Rotation.from_quat(rot[j], scalar_first=True)
    if PARENTS[j] < 0:
        return root, own
    pos, quat = naive(offsets, root, rot, PARENTS[j])
    return pos + quat.apply(offsets[j]), quat * own


def test_positions_and_rotations_equal_the_recursion():
    rng = torch.Generator().manual_seed(0)
    offsets = torch.randn(6, 3, generator=rng, dtype=torch.float64)
    root = torch.randn(2, 4, 3, generator=rng, dtype=torch.float64)
    rot = normalize(torch.randn(2, 4, 6, 4, generator=rng, dtype=torch.float64))
    pos, quat = forward_kinematics(PARENTS, offsets, root, rot)
    assert pos.shape == (2, 4, 6, 3) and quat.shape == (2, 4, 6, 4)
    for a in range(2):
        for b in range(4):
            for j in range(6):
                p, q = naive(offsets.numpy(), root[a, b].numpy(), rot[a, b].numpy(), j)
                np.testing.assert_allclose(pos[a, b, j], p, atol=1e-12)
                twin = Rotation.from_quat(quat[a, b, j].numpy(), scalar_first=True)
                assert (twin * q.inv()).magnitude() < 1e-7


def test_the_roots_offset_is_ignored_and_nothing_is_changed():
    offsets, root = torch.full((6, 3), 9.0), torch.zeros(3)
    rot = torch.tensor([1.0, 0, 0, 0]).repeat(6, 1)
    before = rot.clone()
    pos, _ = forward_kinematics(PARENTS, offsets, root, rot)
    assert pos[0].tolist() == [0.0, 0.0, 0.0] and pos[4].tolist() == [27.0] * 3
    assert torch.equal(rot, before)


def test_a_tree_of_many_joints_is_joined_by_doubling_alike():
    rng = torch.Generator().manual_seed(1)
    count = 700
    parents = [-1, *(max(0, j - 1 - j % 3) for j in range(1, count))]
    offsets = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    root = torch.randn(5, 3, generator=rng, dtype=torch.float64)
    rot = normalize(torch.randn(5, count, 4, generator=rng, dtype=torch.float64))
    pos, quat = forward_kinematics(parents, offsets, root, rot)
    for j, parent in enumerate(parents):
        if parent < 0:
            assert torch.equal(pos[:, j], root) and torch.equal(quat[:, j], rot[:, j])
            continue
        step = quat_rotate(quat[:, parent], offsets[j].expand(5, 3))
        torch.testing.assert_close(pos[:, j], pos[:, parent] + step, atol=1e-9, rtol=0)
        torch.testing.assert_close(quat[:, j], quat_mul(quat[:, parent], rot[:, j]), atol=1e-9, rtol=0)
