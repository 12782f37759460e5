"""Tangent differences against MuJoCo's own, slopes against its derivatives where nothing touches."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from poise.body import generate_table, make_humanoid
from poise.papers.perpetual.lqr import driven, linearise
from poise.sim import CpuBackend, alone, difference, displaced
from toy_human import human

UNIT = torch.tensor([100.0] * 3 + [30.0] * 3, dtype=torch.float64)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return alone(make_humanoid(human(), generate_table(human())))


def states(model: mujoco.MjModel, count: int, height: float) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(3)
    data = mujoco.MjData(model)
    qpos = np.tile(data.qpos, (count, 1))
    qpos[:, 2] += height
    qpos[:, 3:7] = rng.normal(size=(count, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 7:] += 0.1 * rng.normal(size=(count, model.nu))
    return torch.from_numpy(qpos), torch.from_numpy(0.5 * rng.normal(size=(count, model.nv)))


def test_differences_are_those_of_mujoco(model: mujoco.MjModel) -> None:
    (qpos, _), (_, by) = states(model, 20, 1.0), states(model, 20, 1.0)
    moved, way = displaced(qpos, by), np.empty(model.nv)
    for k in range(20):
        there = qpos[k].numpy().copy()
        mujoco.mj_integratePos(model, there, by[k].numpy(), 1.0)
        mujoco.mj_differentiatePos(model, way, 1.0, qpos[k].numpy(), there)
        np.testing.assert_allclose(difference(moved, qpos)[k], way, atol=1e-9)
        np.testing.assert_allclose(moved[k], there, atol=1e-9)


def test_successors_do_not_depend_on_what_a_world_did_before(model: mujoco.MjModel) -> None:
    backend, (qpos, qvel) = CpuBackend(model, 8, 1), states(model, 4, 0.0)
    ctrl, applied = torch.zeros(4, model.nu), torch.zeros(4, model.nv, dtype=torch.float64)
    first = backend.successors(qpos, qvel, ctrl, applied, 2)
    backend.successors(qpos.flip(0), qvel.flip(0), ctrl + 1.0, applied, 2)
    again = backend.successors(qpos, qvel, ctrl, applied, 2)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    backend.write(torch.arange(4), qpos, qvel)
    backend.drive.clear()
    backend.step(2)
    torch.testing.assert_close(backend.state.qpos[:4], first[0], atol=1e-7, rtol=0)


def test_slopes_in_the_air_are_the_derivatives(model: mujoco.MjModel) -> None:
    backend, (qpos, qvel) = CpuBackend(model, 700, 1), states(model, 3, 3.0)
    action = torch.cat((qpos[:, 7:], torch.zeros(3, 6, dtype=torch.float64)), 1)
    got = linearise(backend, qpos, qvel, action, UNIT, 2, 1e-4)
    assert got.a.shape == (3, 2 * model.nv, 2 * model.nv) and got.b.shape[2] == model.nu + 6
    # A wrench of one unit moves the whole mass.
    mass, step = model.body_subtreemass[1], 2 * model.opt.timestep
    data = mujoco.MjData(model)
    for k in range(3):
        centre = []
        for sign in (1.0, -1.0):
            pushed = action[k : k + 1].clone()
            pushed[0, -6] += sign
            q, v = backend.successors(
                qpos[k : k + 1], qvel[k : k + 1], *driven(pushed, model.nv, UNIT), 2
            )
            data.qpos[:], data.qvel[:] = q[0], v[0]
            mujoco.mj_forward(model, data)
            mujoco.mj_subtreeVel(model, data)
            centre.append(data.subtree_linvel[1].copy())
        np.testing.assert_allclose((centre[0] - centre[1])[0] / 2, 100.0 * step / mass, rtol=0.01)
    # The linear model says where a displaced state goes.
    by = 1e-3 * torch.from_numpy(np.random.default_rng(1).normal(size=(3, 2 * model.nv)))
    q, v = displaced(qpos, by[:, : model.nv]), qvel + by[:, model.nv :]
    q, v = backend.successors(q, v, *driven(action, model.nv, UNIT), 2)
    moved = torch.cat((difference(q, got.qpos), v - got.qvel), 1)
    said = torch.einsum("nij,nj->ni", torch.from_numpy(got.a).double(), by)
    assert float((moved - said).norm() / moved.norm()) < 0.01


def test_large_differences_see_the_floor_that_small_ones_miss(model: mujoco.MjModel) -> None:
    """A foot 2 cm above the floor: the slope of the vertical speed knows of it only from afar."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    qpos = torch.from_numpy(data.qpos.copy())[None]
    lowest = min(
        float(data.geom_xpos[g, 2] - model.geom_rbound[g])
        for g in range(model.ngeom)
        if model.geom_bodyid[g]
    )
    qpos[0, 2] -= lowest
    backend, qvel = CpuBackend(model, 700, 1), torch.zeros(1, model.nv, dtype=torch.float64)
    action = torch.cat((qpos[:, 7:], torch.zeros(1, 6, dtype=torch.float64)), 1)
    height = 0.02
    for _ in range(60):  # Down to where the feet just touch in one step.
        q = qpos.clone()
        q[0, 2] -= height
        if float(backend.successors(q, qvel, *driven(action, model.nv, UNIT), 2)[1][0, 2]) > -0.25:
            break
        height += 0.005
    qpos[0, 2] -= height - 0.03
    near, far = (linearise(backend, qpos, qvel, action, UNIT, 2, size).a[0] for size in (1e-4, 0.2))
    z = model.nv + 2
    assert near[z, 2] == pytest.approx(0.0, abs=0.05)
    assert far[z, 2] < -0.5
