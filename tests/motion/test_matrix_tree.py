"""Kinematics by levels of matrices against joints one by one in quaternions; 6D and headings."""

from __future__ import annotations

import math

import torch

from poise.motion.rotations import (
    axis_heading,
    forward_kinematics,
    matrix_kinematics,
    normalize,
    quat_mul,
    quat_rotate,
    quat_to_matrix,
    quat_to_sixd,
    sixd_to_matrix,
)

PARENTS = (-1, 0, 1, 2, 0, 4, 1)


def _random(*shape: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(0)
    return normalize(torch.randn(*shape, 4, generator=g, dtype=torch.float64))


def test_levels_of_matrices_are_the_joints_one_by_one() -> None:
    rot, root = _random(5, 3, 7), torch.randn(5, 3, 3, dtype=torch.float64)
    offsets = torch.randn(7, 3, dtype=torch.float64)
    pos, quat = forward_kinematics(PARENTS, offsets, root, rot)
    mine, mats = matrix_kinematics(PARENTS, offsets, root, quat_to_matrix(rot))
    assert torch.allclose(mine, pos, atol=1e-12)
    assert torch.allclose(mats, quat_to_matrix(quat), atol=1e-12)


def test_every_window_may_have_bones_of_its_own() -> None:
    rot, root = _random(2, 3, 7), torch.zeros(2, 3, 3, dtype=torch.float64)
    offsets = torch.randn(2, 1, 7, 3, dtype=torch.float64)
    both = matrix_kinematics(PARENTS, offsets, root, quat_to_matrix(rot))[0]
    for k in range(2):
        alone = matrix_kinematics(PARENTS, offsets[k, 0], root[k], quat_to_matrix(rot[k]))[0]
        assert torch.allclose(both[k], alone, atol=1e-12)


def test_six_numbers_give_the_matrix_back_and_any_six_a_rotation() -> None:
    q = _random(50)
    assert torch.allclose(sixd_to_matrix(quat_to_sixd(q)), quat_to_matrix(q), atol=1e-12)
    m = sixd_to_matrix(torch.randn(50, 6, dtype=torch.float64))
    assert torch.allclose(m @ m.mT, torch.eye(3, dtype=torch.float64).expand(50, 3, 3), atol=1e-9)
    assert torch.allclose(torch.linalg.det(m), torch.ones(50, dtype=torch.float64))


def test_a_heading_turns_with_the_body_and_points_where_the_axis_does() -> None:
    q, axis = _random(20), torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64)
    h = axis_heading(q, axis)
    ahead = quat_rotate(q, axis.expand(20, 3)) * torch.tensor([1.0, 1.0, 0.0])
    plus_x = torch.tensor([1.0, 0, 0], dtype=torch.float64).expand(20, 3)
    assert torch.allclose(quat_rotate(h, plus_x), normalize(ahead), atol=1e-12)
    turn = torch.tensor([math.cos(0.4), 0, 0, math.sin(0.4)], dtype=torch.float64).expand(20, 4)
    turned = axis_heading(quat_mul(turn, q), axis)
    same = (turned * quat_mul(turn, h)).sum(-1).abs()
    assert torch.allclose(same, torch.ones(20, dtype=torch.float64))
