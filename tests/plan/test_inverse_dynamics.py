"""Inverse dynamics with contacts: Newton's laws, forward dynamics as a twin, SciPy as a twin."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.optimize import nnls

from poise.body import generate_table, make_humanoid
from poise.plan.expert import (
    ClearanceRule,
    ContactRule,
    TouchPoints,
    clearance,
    inverse_dynamics,
    step_midpoints,
)
from refusals import refused
from toy_human import human

G = 9.81


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return make_humanoid(human(), generate_table(human())).model


def stand(model: mujoco.MjModel, height: float = 0.0) -> np.ndarray:
    """`(1, nq)`, the toy human upright with its lowest point at `height`."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    qpos = data.qpos.copy()
    qpos[2] += height - TouchPoints(model).place(data)[:, 2].min()
    return qpos[None]


def still(model: mujoco.MjModel) -> np.ndarray:
    return np.zeros((1, model.nv))


def test_standing_is_carried_by_the_feet(model: mujoco.MjModel) -> None:
    out = inverse_dynamics(model, stand(model), still(model), still(model))
    weight = model.body_subtreemass[1] * G
    assert out.contact_force[0, :, 2].sum() == pytest.approx(weight, rel=0.01)
    assert np.linalg.norm(out.root_force) < 0.01 * weight
    assert np.linalg.norm(out.root_torque) < 1.0
    feet = [model.body(f"{side}Foot").id - 1 for side in ("Left", "Right")]
    assert out.contact_force[0, np.isin(out.contact_body, feet), 2].sum() > 0.9 * weight


def test_free_fall_needs_nothing(model: mujoco.MjModel) -> None:
    fall = still(model)
    fall[0, 2] = -G
    out = inverse_dynamics(model, stand(model, 0.5), still(model), fall)
    for value in (out.torque, out.root_force, out.root_torque, out.contact_force):
        np.testing.assert_allclose(value, 0.0, atol=1e-6)


def test_hanging_in_the_air_takes_the_whole_weight(model: mujoco.MjModel) -> None:
    out = inverse_dynamics(model, stand(model, 0.5), still(model), still(model))
    np.testing.assert_allclose(out.root_force[0], [0, 0, model.body_subtreemass[1] * G], atol=1e-6)
    assert not out.contact_force.any()


def test_fast_points_carry_nothing(model: mujoco.MjModel) -> None:
    slide = still(model)
    slide[0, 0] = 3.0
    assert not inverse_dynamics(model, stand(model), slide, still(model)).contact_force.any()


@pytest.mark.parametrize("mu", [0.0, 0.4, 1.0])
def test_forces_stay_inside_their_pyramids(model: mujoco.MjModel, mu: float) -> None:
    push = still(model)
    push[0, :3] = (6.0, -2.0, 1.0)
    out = inverse_dynamics(model, stand(model), still(model), push, ContactRule(friction=mu))
    f = out.contact_force[0]
    assert (f[:, 2] >= -1e-9).all() and f[:, 2].sum() > 100
    assert (np.abs(f[:, :2]).sum(-1) <= mu * f[:, 2] + 1e-6).all()
    # Six metres per second squared are more than the friction gives: the root must make it up.
    assert out.root_force[0, 0] > 50 or mu == 1.0


def _moving(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    qpos = np.repeat(stand(model), 3, 0)
    qpos[:, 7:] += rng.normal(0, 0.05, (3, model.nq - 7))
    qpos[:, 2] -= 0.02
    return qpos, rng.normal(0, 0.1, (3, model.nv)), rng.normal(0, 2.0, (3, model.nv))


def test_forward_dynamics_gives_the_acceleration_back(model: mujoco.MjModel) -> None:
    qpos, qvel, qacc = _moving(model)
    out = inverse_dynamics(model, qpos, qvel, qacc)
    assert out.contact_force.any(axis=(1, 2)).all()
    bare = mujoco.MjModel.__copy__(model)
    bare.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    bare.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    bare.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
    data = mujoco.MjData(bare)
    for t in range(3):
        data.qpos[:], data.qvel[:] = qpos[t], qvel[t]
        mujoco.mj_forward(bare, data)
        applied = np.concatenate((out.root_force[t], out.root_torque[t], out.torque[t]))
        for p, f in enumerate(out.contact_force[t]):
            body = int(out.contact_body[p]) + 1
            mujoco.mj_applyFT(bare, data, f, np.zeros(3), out.contact_point[t, p], body, applied)
        data.qfrc_applied[:] = applied
        mujoco.mj_forward(bare, data)
        np.testing.assert_allclose(data.qacc, qacc[t], atol=1e-6)


def test_the_programme_is_solved_as_by_scipy(model: mujoco.MjModel) -> None:
    rule = ContactRule(speed=1e3, effort=0.1)
    qpos, qvel, qacc = (x[:1] for x in _moving(model))
    out = inverse_dynamics(model, qpos, 0 * qvel, qacc, rule)
    free = inverse_dynamics(model, qpos, 0 * qvel, qacc, ContactRule(height_m=-1.0))
    weight, place = model.body_subtreemass[1] * G, out.contact_point[0]
    low = np.flatnonzero(place[:, 2] < rule.height_m)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, qpos[0, 3:7])
    moment = turn.reshape(3, 3) @ free.root_torque[0]
    goal = np.concatenate((free.root_force[0], moment / rule.lever_m)) / weight
    columns, price = [], []
    for p in low:
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            f = np.array([x, y, 1.0])
            columns.append(np.concatenate((f, np.cross(place[p] - qpos[0, :3], f) / rule.lever_m)))
            price.append(rule.effort * np.sqrt(1 + 30 * (max(place[p, 2], 0) / rule.height_m) ** 2))
    matrix = np.vstack((np.array(columns).T, np.diag(price)))
    share, _ = nnls(matrix, np.concatenate((goal, np.zeros(len(price)))))
    total = share.reshape(-1, 4).sum(1) * weight
    np.testing.assert_allclose(out.contact_force[0, low, 2], total, atol=0.01)


def test_midpoints_of_a_fall(model: mujoco.MjModel) -> None:
    rate, t = 30.0, np.arange(4) / 30.0
    qpos, qvel = np.repeat(stand(model, 2.0), 4, 0), np.zeros((4, model.nv))
    qpos[:, 2] += -0.5 * G * t**2
    qvel[:, 2] = -G * t
    mid, speed, acc = step_midpoints(model, qpos, qvel, rate)
    np.testing.assert_allclose(mid[:, 2], 0.5 * (qpos[1:, 2] + qpos[:-1, 2]))
    np.testing.assert_allclose(speed[:, 2], -G * (t[:-1] + 0.5 / rate))
    np.testing.assert_allclose(acc[:, 2], -G)
    np.testing.assert_allclose(np.delete(acc, 2, 1), 0.0)


def test_shapes_that_do_not_fit_are_named(model: mujoco.MjModel) -> None:
    with refused("wrong-shape", says=("qvel", "(1, 3)")):
        inverse_dynamics(model, stand(model), np.zeros((1, 3)), still(model))


def test_swinging_feet_are_lifted_and_standing_ones_left_alone(model: mujoco.MjModel) -> None:
    qpos, swing = np.repeat(stand(model, -0.01), 5, 0), np.zeros((5, model.nv))
    assert not clearance(model, qpos, swing).any()
    swing[:, 0] = 2.0
    rule = ClearanceRule(height_m=0.02)
    lifted, data = qpos.copy(), mujoco.MjData(model)
    lifted[:, 7:] += clearance(model, qpos, swing, rule)
    data.qpos[:] = lifted[2]
    mujoco.mj_kinematics(model, data)
    assert TouchPoints(model).place(data)[:, 2].min() > 0.015
