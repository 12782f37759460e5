"""Residual forces against MuJoCo's own mj_applyFT and mj_jac, Newton's law, and hand-made numbers."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from poise.body import generate_table, make_humanoid
from poise.control import ExplicitResidual, ImplicitResidual
from poise.motion.rotations import heading_quat, quat_rotate
from poise.sim import CpuBackend, Drive
from refusals import refused
from toy_human import human

N = 3


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return make_humanoid(human(), generate_table(human())).model


@pytest.fixture
def worlds(model: mujoco.MjModel) -> tuple[list[mujoco.MjData], tuple[torch.Tensor, ...], Drive]:
    """N random states: their MjData, (xpos, xquat, xipos), an empty drive."""
    rng = np.random.default_rng(0)
    datas = []
    for _ in range(N):
        data = mujoco.MjData(model)
        data.qpos[:] = 0.5 * rng.standard_normal(model.nq)
        data.qpos[2] = 5.0
        data.qvel[:] = rng.standard_normal(model.nv)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        datas.append(data)
    arrays = tuple(
        torch.tensor(np.stack([getattr(d, k) for d in datas])) for k in ("xpos", "xquat", "xipos")
    )
    return datas, arrays, Drive.zeros(N, model.nu, model.nv, model.nbody)


def generalized(model: mujoco.MjModel, data: mujoco.MjData, xfrc: np.ndarray) -> np.ndarray:
    """J^T of Cartesian forces at the inertial centres, as MuJoCo maps xfrc_applied."""
    out = np.zeros(model.nv)
    for b in range(1, model.nbody):
        mujoco.mj_applyFT(model, data, xfrc[b, :3], xfrc[b, 3:], data.xipos[b], b, out)
    return out


def test_explicit_equals_the_jacobian_transpose_map(model, worlds):
    datas, (xpos, xquat, xipos), drive = worlds
    bodies = (0, 4, 7)
    kind = ExplicitResidual(bodies, limit_n=80.0, limit_nm=40.0)
    action = 0.1 * torch.randn(N, kind.dims, generator=torch.Generator().manual_seed(1)).double()
    wrench = kind.apply(action, xpos, xquat, xipos, drive)
    parts = action.reshape(N, 3, 3, 3).numpy()
    for i, data in enumerate(datas):
        twin, by_jac = np.zeros(model.nv), np.zeros(model.nv)
        for k, row in enumerate(bodies):
            b = row + 1
            turn = data.xmat[b].reshape(3, 3)
            point = data.xpos[b] + turn @ parts[i, k, 0]
            force, torque = turn @ parts[i, k, 1] * 80.0, turn @ parts[i, k, 2] * 40.0
            mujoco.mj_applyFT(model, data, force, torque, point, b, twin)
            jacp, jacr = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacp, jacr, point, b)
            by_jac += jacp.T @ force + jacr.T @ torque
            np.testing.assert_allclose(wrench.force[i, k], force, atol=1e-12)
            np.testing.assert_allclose(wrench.torque[i, k], torque, atol=1e-12)
            np.testing.assert_allclose(wrench.point[i, k], point, atol=1e-12)
        ours = generalized(model, data, drive.xfrc_applied[i].numpy())
        np.testing.assert_allclose(ours, twin, atol=1e-9)
        np.testing.assert_allclose(ours, by_jac, atol=1e-9)
    assert wrench.body == bodies and not drive.qfrc_applied.any()


def test_implicit_equals_a_wrench_at_the_root(model, worlds):
    datas, (xpos, xquat, xipos), drive = worlds
    kind = ImplicitResidual(limit_n=90.0, limit_nm=30.0)
    action = 0.2 * torch.randn(N, 6, generator=torch.Generator().manual_seed(2)).double()
    wrench = kind.apply(action, xpos, xquat, xipos, drive)
    heading = heading_quat(xquat[:, 1])
    torch.testing.assert_close(wrench.force[:, 0], quat_rotate(heading, action[:, :3] * 90.0))
    torch.testing.assert_close(wrench.torque[:, 0], quat_rotate(xquat[:, 1], action[:, 3:] * 30.0))
    for i, data in enumerate(datas):
        twin = np.zeros(model.nv)
        force, torque = wrench.force[i, 0].numpy(), wrench.torque[i, 0].numpy()
        mujoco.mj_applyFT(model, data, force, torque, data.xpos[1], 1, twin)
        np.testing.assert_allclose(drive.qfrc_applied[i].numpy(), twin, atol=1e-9)
    assert not drive.xfrc_applied.any()


def test_implicit_force_moves_a_free_body_as_f_over_m():
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="root", pos=[0, 0, 1], quat=[0.5**0.5, 0, 0, 0.5**0.5])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], mass=4.0)
    spec.option.timestep = 0.01
    backend = CpuBackend(spec, 1, 1)
    # 39.24 N upwards carry the weight, 8 N along the heading push: half of 100 N is the unit.
    action = torch.tensor([[0.08, 0.0, 0.3924, 0.0, 0.0, 0.0]], dtype=torch.float64)
    kind, state = ImplicitResidual(limit_n=100.0, limit_nm=0.0), backend.state
    for _ in range(100):
        backend.drive.clear()
        kind.apply(action, state.xpos, state.xquat, state.xipos, backend.drive)
        backend.step(1)
    # The body faces +y: after one second at 8 N / 4 kg its speed is 2 m/s along y.
    np.testing.assert_allclose(state.qvel[0, :3], [0.0, 2.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(state.qpos[0, [0, 2]], [0.0, 1.0], atol=1e-9)
    assert float(state.qpos[0, 1]) == pytest.approx(1.0, abs=0.02)
    backend.close()


KINDS = [ImplicitResidual(), ExplicitResidual((0, 3))]


@pytest.mark.parametrize("kind", KINDS)
def test_zero_action_is_exactly_nothing(kind, worlds):
    _, (xpos, xquat, xipos), drive = worlds
    wrench = kind.apply(torch.zeros(N, kind.dims).double(), xpos, xquat, xipos, drive)
    assert not drive.qfrc_applied.any() and not drive.xfrc_applied.any() and not drive.ctrl.any()
    assert not wrench.force.any() and not wrench.torque.any()
    assert kind.regularizer(torch.zeros(N, kind.dims)).tolist() == [1.0] * N


@pytest.mark.parametrize("kind", [ImplicitResidual(0.0, 0.0), ExplicitResidual((0, 3), 0.0, 0.0)])
def test_zero_limits_switch_the_help_off(kind, worlds):
    _, (xpos, xquat, xipos), drive = worlds
    kind.apply(torch.full((N, kind.dims), 5.0).double(), xpos, xquat, xipos, drive)
    assert not drive.qfrc_applied.any() and not drive.xfrc_applied.any()


@pytest.mark.parametrize("size", [0.1, 1.0, 30.0])
def test_norms_never_exceed_the_limits(size, worlds):
    _, (xpos, xquat, xipos), drive = worlds
    rng = torch.Generator().manual_seed(3)
    for kind in (ImplicitResidual(50.0, 20.0), ExplicitResidual((0, 2, 5), 50.0, 20.0, reach_m=0.2)):
        action = size * torch.randn(N, kind.dims, generator=rng).double()
        wrench = kind.apply(action, xpos, xquat, xipos, drive)
        assert float(wrench.force.norm(dim=-1).sum(-1).max()) <= 50.0 + 1e-9
        assert float(wrench.torque.norm(dim=-1).sum(-1).max()) <= 20.0 + 1e-9
        reach = (wrench.point - xpos[:, [b + 1 for b in wrench.body]]).norm(dim=-1)
        assert float(reach.max()) <= 0.2 + 1e-9
        if size == 30.0:
            # The direction of what was asked for stays.
            torch.testing.assert_close(
                wrench.force.norm(dim=-1).sum(-1), torch.full((N,), 50.0).double()
            )


@pytest.mark.parametrize("kind", [ImplicitResidual, ExplicitResidual])
def test_without_a_cap_the_limits_only_scale_the_action(kind, worlds):
    _, (xpos, xquat, xipos), drive = worlds
    free = kind(limit_n=50.0, limit_nm=20.0, capped=False)
    action = 3.0 * torch.randn(N, free.dims, generator=torch.Generator().manual_seed(3)).double()
    wrench = free.apply(action, xpos, xquat, xipos, drive)
    # Force and torque are the last two vectors, the contact point of the explicit form is the first.
    sizes = action.reshape(N, -1, 3).norm(dim=-1)
    torch.testing.assert_close(wrench.force.norm(dim=-1)[:, 0], 50.0 * sizes[:, -2])
    torch.testing.assert_close(wrench.torque.norm(dim=-1)[:, 0], 20.0 * sizes[:, -1])
    assert float(wrench.force.norm(dim=-1).min()) > 50.0
    if kind is ExplicitResidual:
        torch.testing.assert_close((wrench.point[:, 0] - xpos[:, 1]).norm(dim=-1), sizes[:, 0])


@pytest.mark.parametrize("kind", [ImplicitResidual(80.0, 40.0), ExplicitResidual((0, 3), 80.0, 40.0)])
def test_each_world_may_have_a_scale_of_its_own(kind, worlds):
    _, arrays, _ = worlds
    action = torch.randn(N, kind.dims, generator=torch.Generator().manual_seed(4)).double()
    scales = torch.tensor([1.0, 0.3, 0.0])
    sizes = (worlds[2].ctrl.shape[1], worlds[2].qfrc_applied.shape[1], worlds[2].xfrc_applied.shape[1])
    together = Drive.zeros(N, *sizes)
    kind.apply(action, *arrays, together, scales)
    for i, scale in enumerate(scales):
        alone = Drive.zeros(1, *sizes)
        kind.apply(action[i : i + 1], *(x[i : i + 1] for x in arrays), alone, scale)
        for name in ("qfrc_applied", "xfrc_applied"):
            assert torch.equal(getattr(together, name)[i], getattr(alone, name)[0])
    assert float(together.qfrc_applied[2].abs().max() + together.xfrc_applied[2].abs().max()) == 0.0


def test_residuals_add_to_what_is_there(worlds):
    _, (xpos, xquat, xipos), drive = worlds
    for kind in KINDS:
        action = 0.1 * torch.ones(N, kind.dims).double()
        drive.clear()
        kind.apply(action, xpos, xquat, xipos, drive)
        once = drive.qfrc_applied.clone(), drive.xfrc_applied.clone()
        kind.apply(action, xpos, xquat, xipos, drive)
        torch.testing.assert_close(drive.qfrc_applied, 2 * once[0])
        torch.testing.assert_close(drive.xfrc_applied, 2 * once[1])


def test_regularizers_by_hand():
    action = torch.tensor([[1.0, 0, 0, 0, 2.0, 0]])
    assert float(ImplicitResidual(k_r=0.5).regularizer(action)) == pytest.approx(math.exp(-2.5))
    # One body: point (0.5, 0, 0), force (1, 0, 0), torque (0, 0, 2).
    action = torch.tensor([[0.5, 0, 0, 1.0, 0, 0, 0, 0, 2.0]])
    kind = ExplicitResidual(k_f=0.1, k_cp=4.0)
    assert float(kind.regularizer(action)) == pytest.approx(math.exp(-(0.1 * 5.0 + 4.0 * 0.25)))


def test_mistakes_are_told():
    for value in (-1.0, math.inf, math.nan):
        with refused("out-of-range", says="limit_n"):
            ImplicitResidual(limit_n=value)
        with refused("out-of-range", says="limit_nm"):
            ExplicitResidual(limit_nm=value)
    for bodies, code in (((), "out-of-range"), ((1, 1), "name-repeated")):
        with refused(code, says="bodies"):
            ExplicitResidual(bodies)
