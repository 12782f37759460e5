"""Jacobians, inertia and the step map against MuJoCo's own."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.sim import Character, CpuBackend, Mechanics, Scene, SceneSim, SimConfig
from poise.sim.props import Ball
from refusals import refused
from toy_human import swing

N = 5


def standing(backend: CpuBackend, z: float = 3.0) -> Tensor:
    """Random poses high above the floor, in motion; draws of the same generator follow."""
    model, rng = backend.model, torch.Generator().manual_seed(7)
    qpos = torch.randn(N, model.nq, generator=rng, dtype=torch.float64)
    qpos[:, 2] = z
    qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
    qpos[:, 7:] *= 0.3
    qvel = torch.randn(N, model.nv, generator=rng, dtype=torch.float64)
    backend.write(None, qpos, qvel)
    return torch.randn(N, model.nv, generator=rng, dtype=torch.float64)


@pytest.fixture
def worlds(make_spec: Callable[..., mujoco.MjSpec]) -> tuple[CpuBackend, Mechanics, Tensor]:
    backend = CpuBackend(make_spec(), N, 1)
    return backend, Mechanics(backend), standing(backend)


def test_jacobians_are_those_of_mujoco(worlds: tuple[CpuBackend, Mechanics, Tensor]) -> None:
    backend, mechanics, _ = worlds
    backend.step(3)
    rng = torch.Generator().manual_seed(1)
    body = torch.randint(0, backend.model.nbody, (N, 4), generator=rng)
    point = torch.randn(N, 4, 3, generator=rng, dtype=torch.float64)
    linear, turning = mechanics.jacobian(body, point)
    jac = np.zeros((2, 3, backend.model.nv))
    for n in range(N):
        data = backend.get_data(n)
        mujoco.mj_forward(backend.model, data)
        for k in range(4):
            mujoco.mj_jac(backend.model, data, jac[0], jac[1], point[n, k].numpy(), int(body[n, k]))
            np.testing.assert_allclose(linear[n, k], jac[0], atol=1e-9)
            np.testing.assert_allclose(turning[n, k], jac[1], atol=1e-9)
    # One body for all worlds, and a list of them, are the same.
    one = mechanics.jacobian(2, point[:, 0])
    few = mechanics.jacobian([2, 3], point[:, :2])
    assert one[0].shape == (N, 3, backend.model.nv) and torch.equal(one[0], few[0][:, 0])
    assert torch.equal(one[1], few[1][:, 0])


def test_inertia_is_that_of_mujoco(worlds: tuple[CpuBackend, Mechanics, Tensor]) -> None:
    backend, mechanics, force = worlds
    backend.step(2)
    got, mass = mechanics.solve(force), mechanics.inertia()
    model = backend.model
    for n in range(N):
        data, want = backend.get_data(n), np.zeros((1, model.nv))
        mujoco.mj_forward(model, data)
        mujoco.mj_solveM(model, data, want, force[n : n + 1].numpy())
        np.testing.assert_allclose(got[n], want[0], atol=1e-9, rtol=1e-9)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        np.testing.assert_allclose(mass[n], full, atol=1e-12)
    several = mechanics.solve(torch.stack((force, 2 * force), 2))
    torch.testing.assert_close(several[..., 1], 2 * got)


def test_a_force_at_a_point_accelerates_it(make_spec: Callable[..., mujoco.MjSpec]) -> None:
    """J M^-1 J^T f against the simulator's own accelerations."""
    backend = CpuBackend(make_spec(gravity=False, config=SimConfig(integrator="euler")), N, 1)
    mechanics = Mechanics(backend)
    backend.state.bind(("qacc",))
    standing(backend)
    force = torch.tensor([[3.0, -2.0, 5.0]]).double().expand(N, 3)
    point = backend.state.xpos[:, 2].clone()
    linear, _ = mechanics.jacobian(2, point)
    want = mechanics.solve((linear.transpose(1, 2) @ force[..., None])[..., 0])
    backend.forward()
    still = backend.state["qacc"].clone()
    backend.drive.add_wrench_at(2, point, force, xipos=backend.state.xipos)
    backend.forward()
    torch.testing.assert_close(backend.state["qacc"] - still, want, atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize("integrator", ["euler", "discrete"])
def test_the_step_map(integrator: str, make_spec: Callable[..., mujoco.MjSpec]) -> None:
    backend = CpuBackend(make_spec(config=SimConfig(integrator=integrator)), N, 1)
    twin = CpuBackend(make_spec(config=SimConfig(integrator=integrator)), N, 1)
    mechanics = Mechanics(backend)
    force = standing(backend)
    standing(twin)
    before = backend.snapshot()
    change = mechanics.step_map(force)
    assert torch.equal(backend.snapshot(), before)
    backend.step(1)
    twin.drive.qfrc_applied.add_(force)
    twin.step(1)
    torch.testing.assert_close(twin.state.qvel - backend.state.qvel, change, atol=1e-12, rtol=0)
    backend.restore(before)
    h, damping = backend.model.opt.timestep, torch.from_numpy(backend.model.dof_damping)
    free = h * torch.linalg.solve(mechanics.inertia() + h * damping.diag(), force)
    if integrator == "euler":
        torch.testing.assert_close(change, free, atol=1e-9, rtol=1e-9)
    else:
        # Stiff servos give way less than inertia and damping alone.
        assert float(change[:, 6:].norm()) < 0.9 * float(free[:, 6:].norm())


def test_mistakes(worlds: tuple[CpuBackend, Mechanics, Tensor]) -> None:
    _, mechanics, force = worlds
    point = torch.zeros(N, 3, dtype=torch.float64)
    with refused("index-outside", says="3"):
        mechanics.jacobian(4, point)
    with refused("wrong-shape", says=("5, 2, 3", "5, 3")):
        mechanics.jacobian([1, 2], point)
    with refused("wrong-shape", says=("5, 8", "5, 3")):
        mechanics.solve(point)
    with refused("wrong-shape", says=("5, 8", "4, 8")):
        mechanics.step_map(force[:4])


def test_characters_of_a_scene_have_their_own_mechanics() -> None:
    """Whatever stands before and beside them, Jacobians and inertia are those of the body alone."""
    humanoid = build(ClipLibrary.of([swing(1.0)]), ResidualForce(expert=False)).humanoid
    things = (Ball(pos=(0, 9, 1)), Character(humanoid, "anna"), Character(humanoid, "ben"))
    world = SceneSim(Scene(things), 2, threads=1)
    rows = world.characters()
    model, rng = rows.model, torch.Generator().manual_seed(2)
    alone = CpuBackend(model, 4, 1)
    made, beside = Mechanics(rows), Mechanics(alone)
    qpos = torch.tensor(model.qpos0).repeat(4, 1)
    qpos[:, 2], qpos[:, 0] = 3.0, 4.0 * torch.arange(4)
    qpos[:, 7:] += 0.3 * torch.randn(4, model.nq - 7, generator=rng, dtype=torch.float64)
    still = torch.zeros(4, model.nv, dtype=torch.float64)
    for backend in (rows, alone):
        backend.write(None, qpos, still)
        backend.step(2)
    point = rows.state.xpos[:, 5]
    torch.testing.assert_close(made.jacobian(5, point)[0], beside.jacobian(5, point)[0])
    torch.testing.assert_close(made.inertia(), beside.inertia())
    force = torch.randn(4, model.nv, generator=rng, dtype=torch.float64)
    torch.testing.assert_close(made.solve(force), beside.solve(force))
    world.close()
