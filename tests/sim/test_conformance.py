"""What every backend must do; a new backend adds itself to KINDS and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from poise.sim import (
    Backend,
    CpuBackend,
    SimConfig,
    WarpBackend,
    body_angular_velocity_w,
    body_com_velocity_w,
    body_linear_velocity_w,
)
from refusals import refused
from warp_device import WARP_DEVICE, needs_warp

N, STEPS = 6, 2


@dataclass(frozen=True)
class Kind:
    """A backend and how closely it must agree with float64 MuJoCo over a few steps.

    cone: the friction cone for that. The edges of a pyramid have directions, and mujoco_warp chooses
    others than MuJoCo for a capsule that stands steeply on a plane; a round cone has none.
    """

    make: Callable[..., Backend]
    tolerance: float
    cone: str = "pyramidal"


KINDS = {
    "cpu": Kind(CpuBackend, 1e-12),
    # On a GPU sums come in any order unless asked otherwise, and some tests compare bits.
    "warp": Kind(partial(WarpBackend, device=WARP_DEVICE, deterministic=True), 3e-4, "elliptic"),
}


@pytest.fixture(params=["cpu", pytest.param("warp", marks=needs_warp)])
def kind(request: pytest.FixtureRequest) -> Kind:
    return KINDS[request.param]


def close(got: Tensor, expected: object, tolerance: float) -> None:
    want = torch.as_tensor(np.asarray(expected), dtype=torch.float64)
    torch.testing.assert_close(got.double().cpu(), want, rtol=tolerance, atol=tolerance)


def drive_randomly(backend: Backend, seed: int) -> None:
    """Different targets, root forces and pushes in every world."""
    rng = torch.Generator().manual_seed(seed)
    drive = backend.drive
    drive.clear()
    for tensor, size in ((drive.ctrl, 0.5), (drive.qfrc_applied, 3.0), (drive.xfrc_applied, 3.0)):
        tensor += (size * torch.randn(tensor.shape, generator=rng, dtype=torch.float64)).to(tensor)


def test_is_a_backend(kind, make_spec):
    backend = kind.make(make_spec(), N)
    assert isinstance(backend, Backend)
    assert backend.num_envs == N and backend.model.nv == 8
    model_made = kind.make(make_spec().compile(), N)
    assert torch.equal(model_made.state.qpos, backend.state.qpos)


def test_step_equals_a_plain_mujoco_loop(kind, make_spec, random_state):
    backend = kind.make(make_spec(config=SimConfig(cone=kind.cone)), N)
    model = backend.model
    qpos, qvel = random_state(model, N)
    backend.write(None, qpos, qvel)
    worlds = [mujoco.MjData(model) for _ in range(N)]
    for i, data in enumerate(worlds):
        data.qpos[:], data.qvel[:] = qpos[i].numpy(), qvel[i].numpy()
    for k in range(8):
        drive_randomly(backend, k)
        for i, data in enumerate(worlds):
            data.ctrl[:] = backend.drive.ctrl[i].cpu()
            data.qfrc_applied[:] = backend.drive.qfrc_applied[i].cpu()
            data.xfrc_applied[:] = backend.drive.xfrc_applied[i].cpu()
            mujoco.mj_step(model, data, STEPS)
            mujoco.mj_step1(model, data)
        backend.step(STEPS)
        for name in backend.state.names:
            close(backend.state[name], [getattr(d, name) for d in worlds], kind.tolerance)


def test_state_and_drive_are_live(kind, make_spec):
    backend = kind.make(make_spec(), N)
    state, xpos, qpos = backend.state, backend.state.xpos, backend.state.qpos
    first = xpos.clone(), qpos.clone()
    backend.step(STEPS)
    assert state.xpos is xpos and state["qpos"] is qpos
    assert not torch.equal(xpos, first[0]) and not torch.equal(qpos, first[1])
    assert xpos.shape == (N, 4, 3) and state.cvel.shape == (N, 4, 6) and state.time.shape == (N,)
    close(state.time, [STEPS / 60] * N, max(kind.tolerance, 1e-7))
    # The root's origin is the first three coordinates: derived fields are not a step behind.
    close(xpos[:, 1], qpos[:, :3].cpu(), kind.tolerance)


def test_velocities_of_body_frames(kind, make_spec, random_state):
    backend = kind.make(make_spec(), 2)
    model = backend.model
    backend.write(None, *random_state(model, 2))
    backend.step(STEPS)
    data, six = mujoco.MjData(model), np.zeros(6)
    for i in range(2):
        data.qpos[:], data.qvel[:] = backend.state.qpos[i].cpu(), backend.state.qvel[i].cpu()
        mujoco.mj_forward(model, data)
        for body in range(1, model.nbody):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, six, 0)
            tolerance = 10 * kind.tolerance
            close(body_angular_velocity_w(backend.state)[i, body], six[:3], tolerance)
            close(body_linear_velocity_w(backend.state, model)[i, body], six[3:], tolerance)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, six, 0)
            close(body_com_velocity_w(backend.state, model)[i, body], six[3:], tolerance)


def test_a_wrench_accelerates_a_free_body_by_newton_and_euler(kind):
    # One box, 3 kg, its centre off the body's origin, turned in the world.
    spec = mujoco.MjSpec()
    SimConfig(rate_hz=1000, control_hz=500).apply(spec)
    body = spec.worldbody.add_body(name="box")
    body.add_freejoint()
    size, mass = np.array([0.1, 0.2, 0.3]), 3.0
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=[0.3, 0, 0], mass=mass)
    backend = kind.make(spec, 1)
    quat = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)  # x to y, y to z, z to x
    backend.write(None, torch.cat([torch.zeros(3).double(), quat])[None], torch.zeros(1, 6).double())
    centre, force = backend.state.xipos[:, 1].clone(), torch.tensor([[3.0, -6.0, 1.5]])
    weight = torch.tensor([[0.0, 0.0, 9.81 * mass]])
    torque = torch.tensor([[0.1, 0.2, -0.3]])
    backend.drive.clear()
    backend.drive.add_wrench_at(1, centre, weight, xipos=backend.state.xipos)
    backend.drive.add_wrench_at(1, centre, force, torque, xipos=backend.state.xipos)
    backend.step(1)
    h = 1e-3
    # v = h F / m at the inertial centre; omega = h I^-1 tau about the body's axes, in the world.
    inertia_b = (
        mass
        / 3
        * np.array(
            [size[1] ** 2 + size[2] ** 2, size[0] ** 2 + size[2] ** 2, size[0] ** 2 + size[1] ** 2]
        )
    )
    world_from_body = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    omega = h * world_from_body @ ((world_from_body.T @ torque[0].numpy()) / inertia_b)
    close(body_angular_velocity_w(backend.state)[0, 1], omega, max(kind.tolerance, 1e-7))
    close(
        body_com_velocity_w(backend.state, backend.model)[0, 1],
        h * force[0] / mass,
        max(kind.tolerance, 1e-7),
    )


def test_wrenches_equal_mujocos_own_jacobian_map(kind, make_spec, random_state):
    backend = kind.make(make_spec(), N)
    model = backend.model
    backend.write(None, *random_state(model, N))
    rng = torch.Generator().manual_seed(4)
    point, force, torque = torch.randn(3, N, 3, generator=rng, dtype=torch.float64)
    backend.drive.clear()
    backend.drive.add_wrench_at(2, point, force, torque, xipos=backend.state.xipos)
    root = backend.drive.qfrc_applied[:, :6]
    root.add_(torch.cat((force, torque), 1).to(root))
    tolerance = max(1e-9, 100 * kind.tolerance)
    for i in range(N):
        data = backend.get_data(i)
        mujoco.mj_forward(model, data)
        want, on_root = np.zeros(model.nv), np.zeros(model.nv)
        # qfrc_smooth = qfrc_passive - qfrc_bias + qfrc_applied + J^T xfrc_applied + qfrc_actuator
        got = data.qfrc_smooth - data.qfrc_passive + data.qfrc_bias - data.qfrc_applied
        got -= data.qfrc_actuator
        f, t, p = force[i].numpy(), torque[i].numpy(), point[i].numpy()
        mujoco.mj_applyFT(model, data, f, t, p, 2, want)
        close(torch.from_numpy(got), want, tolerance)
        # A free joint takes the force at the body's origin and the torque in the body's axes.
        turn = data.xmat[1].reshape(3, 3)
        mujoco.mj_applyFT(model, data, f, turn @ t, data.xpos[1], 1, on_root)
        close(backend.drive.qfrc_applied[i], on_root, tolerance)


def test_writing_rows_leaves_the_others_alone(kind, make_spec, random_state):
    backend, alone = kind.make(make_spec(), N), kind.make(make_spec(), N)
    model = backend.model
    for b in (backend, alone):
        b.write(None, *random_state(model, N))
        for k in range(5):
            drive_randomly(b, k)
            b.step(STEPS)
    rows = torch.tensor([4, 1])  # Not in order: row 0 of the values belongs to world 4.
    qpos, qvel = random_state(model, 2, seed=9)
    backend.write(rows, qpos, qvel)
    close(backend.state.qpos[rows], qpos, kind.tolerance)
    close(backend.state.qvel[rows], qvel, kind.tolerance)
    assert not backend.state.time[rows].any() and not backend.drive.ctrl[rows].any()
    assert not backend.drive.qfrc_applied[rows].any() and not backend.drive.xfrc_applied[rows].any()
    close(backend.state.xpos[rows, 1], qpos[:, :3], kind.tolerance)
    drive_randomly(backend, 7)
    drive_randomly(alone, 7)
    backend.step(STEPS)
    alone.step(STEPS)
    others = [0, 2, 3, 5]
    assert torch.equal(backend.state.qpos[others], alone.state.qpos[others])
    # A written row forgets its past: it moves as in a fresh simulation (the warm start is gone).
    fresh = kind.make(make_spec(), N)
    fresh.write(torch.tensor([False, True, False, False, True, False]), qpos[[1, 0]], qvel[[1, 0]])
    drive_randomly(fresh, 7)
    fresh.step(STEPS)
    assert torch.equal(fresh.state.qpos[rows], backend.state.qpos[rows])


def test_writing_no_rows_does_nothing(kind, make_spec):
    backend = kind.make(make_spec(), 2)
    before = backend.snapshot()
    backend.write(torch.zeros(2, dtype=torch.bool), torch.zeros(0, 9), torch.zeros(0, 8))
    assert torch.equal(before, backend.snapshot())


def run(backend: Backend, start: int, count: int) -> Tensor:
    out = []
    for k in range(start, start + count):
        drive_randomly(backend, k)
        backend.step(STEPS)
        out.append(torch.cat([backend.snapshot(), backend.contacts().flatten(1)], 1))
    return torch.stack(out)


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_do_not_change_a_bit(make_spec, random_state, threads):
    one, many = (
        CpuBackend(make_spec(sensors=True), 7, 1),
        CpuBackend(make_spec(sensors=True), 7, threads),
    )
    for b in (one, many):
        b.write(None, *random_state(b.model, 7, height=0.4))
    assert torch.equal(run(one, 0, 20), run(many, 0, 20))


@pytest.mark.parametrize("rows", [None, [5, 0, 3]])
def test_snapshot_restores_bit_for_bit(kind, make_spec, random_state, rows):
    backend = kind.make(make_spec(sensors=True), N)
    backend.state.bind(["qacc", "actuator_force"])
    backend.write(None, *random_state(backend.model, N, height=0.4))
    run(backend, 0, 10)
    kept = backend.snapshot()
    ahead = run(backend, 10, 10)
    chosen = None if rows is None else torch.tensor(rows)
    mine = list(range(N)) if rows is None else rows
    backend.restore(kept[mine], chosen)
    assert torch.equal(backend.snapshot()[mine], kept[mine])
    assert torch.equal(run(backend, 10, 10)[:, mine], ahead[:, mine])
    # Another backend of the same model continues it as well, also without the derived fields.
    other = kind.make(make_spec(sensors=True), N)
    backend.restore(kept)
    other.restore(backend.snapshot(derived=False))
    for name in ("qpos", "qvel", "xpos", "xquat", "cvel", "subtree_com"):
        assert torch.equal(other.state[name], backend.state[name])
    other.state.bind(["qacc", "actuator_force"])
    assert torch.equal(run(other, 10, 10), ahead)


def test_snapshot_of_another_model_is_refused(kind, make_spec):
    backend = kind.make(make_spec(), 2)
    with refused("snapshot-differs", says="(2, 5)"):
        backend.restore(torch.zeros(2, 5))


def test_expanded_fields_change_their_world_only(kind, make_spec, random_state):
    backend, plain = kind.make(make_spec(), N), kind.make(make_spec(), N)
    for b in (backend, plain):
        b.write(None, *random_state(b.model, N))
    mass = backend.expand("body_mass")
    assert mass.shape == (N, 4)
    mass[2, 1] *= 3
    backend.expand("opt.gravity")[3] = 0
    backend.set_const()
    assert backend.get_model(2).body_mass[1] == 18 and backend.get_model(0).body_mass[1] == 6
    for b in (backend, plain):
        for k in range(3):
            drive_randomly(b, k)
            b.step(STEPS)
    same = (backend.state.qpos == plain.state.qpos).all(1).tolist()
    assert same == [True, True, False, False, True, True]
    with refused("unknown-field", says="body_mass"):
        backend.expand("body_mas")


def momentum(backend: Backend) -> Tensor:
    """Linear and angular momentum about the world's origin, `(N, 6)`."""
    model, state = backend.model, backend.state
    mass = torch.as_tensor(model.body_mass).to(state.xipos)[:, None]
    linear = mass * body_com_velocity_w(state, model)
    turn = torch.empty(backend.num_envs, model.nbody, 3, 3).to(state.xipos)
    for i in range(backend.num_envs):
        data = backend.get_data(i)
        mujoco.mj_forward(model, data)
        turn[i] = torch.from_numpy(data.ximat).view(-1, 3, 3).to(turn)
    inertia = (
        turn @ torch.diag_embed(torch.as_tensor(model.body_inertia).to(turn)) @ turn.transpose(-1, -2)
    )
    spin = (inertia @ body_angular_velocity_w(state)[..., None])[..., 0]
    return torch.cat([linear, spin + torch.linalg.cross(state.xipos, linear)], -1).sum(1)


def test_momentum_is_kept_without_gravity_and_contact(kind, make_spec, random_state):
    drift = []
    for rate in (480, 960):
        backend = kind.make(make_spec(gravity=False, floor=False, config=SimConfig(rate, 30)), N)
        backend.write(None, *random_state(backend.model, N))
        start = momentum(backend)
        for k in range(6):
            drive_randomly(backend, k)
            backend.drive.qfrc_applied.zero_()
            backend.drive.xfrc_applied.zero_()
            backend.step(rate // 30)
        drift.append(float((momentum(backend) - start).abs().max() / start.abs().max()))
    # Inner forces cannot change momentum; the integrator's error goes with its step.
    assert drift[0] < 0.02 and drift[1] < 0.6 * drift[0]


def test_contact_forces_carry_the_weight(kind, make_spec):
    backend = kind.make(make_spec(sensors=True), 2)
    backend.step(240)
    force = backend.contacts().double()
    weight = 9.81 * float(backend.model.body_mass.sum())
    assert force.shape == (2, 4, 3) and not force[:, 0].any()
    close(force.sum(1)[:, 2], [weight] * 2, 2e-3)
    assert (force[:, 1:, 2] >= 0).all()
    with refused("sensors-missing"):
        kind.make(make_spec(), 1).contacts()


def test_mistakes_are_told(kind, make_spec):
    backend = kind.make(make_spec(), 3)
    qpos, qvel = backend.state.qpos.clone(), backend.state.qvel.clone()
    with refused("wrong-shape", says="(3, 8)"):
        backend.write(None, qvel, qvel)
    with refused("index-outside", says="[1, 1]"):
        backend.write(torch.tensor([1, 1]), qpos[:2], qvel[:2])
    with refused("wrong-shape"):
        backend.forward(torch.ones(2, dtype=torch.bool))
    bad = qpos.clone()
    bad[1, 4] = torch.nan
    with refused("not-finite", says=("qpos", "row 1", "column 4")):
        backend.write(None, bad, qvel)
    with refused("field-unbound", says="qacc"):
        backend.state["qacc"]
    with refused("unknown-field", says="xpos"):
        backend.state.bind(["xposs"])
    with refused("out-of-range"):
        kind.make(make_spec(), 0)
    backend.close()
    with refused("backend-closed"):
        backend.step()
