"""The Drive adds up; a naive loop is the twin."""

from __future__ import annotations

import pytest
import torch

from poise.sim.drive import Drive
from refusals import refused

N, BODIES = 4, 5


def randn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_hand_computed_moment():
    drive, xipos = Drive.zeros(1, 0, 6, 2), torch.zeros(1, 2, 3)
    xipos[0, 1] = torch.tensor([1.0, 0, 0])
    # 2 N upwards, 1 m along y from the centre: the moment is 2 Nm about x.
    drive.add_wrench_at(1, torch.tensor([[1.0, 1, 0]]), torch.tensor([[0.0, 0, 2]]), xipos=xipos)
    assert drive.xfrc_applied[0, 1].tolist() == [0, 0, 2, 2, 0, 0]
    assert not drive.xfrc_applied[0, 0].any()


@pytest.mark.parametrize("per_world", [False, True])
@pytest.mark.parametrize("with_torque", [False, True])
def test_many_bodies_equal_a_loop(per_world, with_torque):
    xipos, point, force = randn(N, BODIES, 3, seed=1), randn(N, 3, 3, seed=2), randn(N, 3, 3, seed=3)
    torque = randn(N, 3, 3, seed=4) if with_torque else None
    body = torch.tensor([[1, 4, 1]]).repeat(N, 1)  # Body 1 twice: both must count.
    if per_world:
        body = (body + torch.arange(N)[:, None]) % BODIES
    drive, twin = Drive.zeros(N, 2, 8, BODIES), Drive.zeros(N, 2, 8, BODIES)
    drive.add_wrench_at(body if per_world else [1, 4, 1], point, force, torque, xipos=xipos)
    for i in range(N):
        for k in range(3):
            b = int(body[i, k])
            moment = torch.linalg.cross(point[i, k] - xipos[i, b], force[i, k])
            twin.xfrc_applied[i, b, :3] += force[i, k]
            twin.xfrc_applied[i, b, 3:] += moment + (0 if torque is None else torque[i, k])
    torch.testing.assert_close(drive.xfrc_applied, twin.xfrc_applied)


def test_wrenches_add_and_clear_takes_all_away():
    drive = Drive.zeros(N, 2, 8, BODIES)
    tensors = drive.ctrl, drive.qfrc_applied, drive.xfrc_applied
    drive.ctrl.add_(1.0)
    drive.qfrc_applied.add_(5.0)
    drive.add_wrench_at(2, randn(N, 3), randn(N, 3), xipos=randn(N, BODIES, 3))
    once = drive.xfrc_applied.clone()
    drive.add_wrench_at(2, randn(N, 3), randn(N, 3), xipos=randn(N, BODIES, 3))
    torch.testing.assert_close(drive.xfrc_applied, 2 * once)
    drive.clear()
    assert not any(bool(t.any()) for t in tensors) and drive.num_envs == N


def test_views_may_be_strided():
    rows = torch.zeros(N, 100, dtype=torch.float64)
    drive = Drive(rows[:, :2], rows[:, 2:10], rows[:, 20:50].view(N, BODIES, 6))
    point, force = randn(N, 2, 3, seed=5), randn(N, 2, 3, seed=6)
    drive.add_wrench_at([0, 3], point, force, xipos=randn(N, BODIES, 3))
    drive.ctrl.add_(1.0)
    assert (rows[:, :2] == 1).all() and rows[:, 20:26].all() and not rows[:, 26:38].any()


def test_shapes_are_checked():
    with refused("wrong-shape", says=("(2, 1)", "(3, 6)")):
        Drive(torch.zeros(2, 1), torch.zeros(3, 6), torch.zeros(2, 2, 6))
