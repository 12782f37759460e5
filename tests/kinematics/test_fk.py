"""Torch kinematics against MuJoCo's own, and velocities against mj_differentiatePos."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from poise.body import generate_table, make_humanoid
from poise.formats import read_clip
from poise.kinematics import Kinematics, fit_humanoid, lowest_height, qpos_velocity
from poise.motion.rotations import quat_angle, quat_conj, quat_mul
from toy_human import human, swing


def check_against_mujoco(humanoid, seed: int) -> None:
    model, data = humanoid.model, mujoco.MjData(humanoid.model)
    rng = np.random.default_rng(seed)
    kin = Kinematics(humanoid.table)
    for _ in range(4):
        data.qpos[:], data.qvel[:] = rng.standard_normal(model.nq), rng.standard_normal(model.nv)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        ours = kin(data.qpos, data.qvel)
        np.testing.assert_allclose(ours.pos, data.xpos[1:], atol=1e-9)
        twist = quat_mul(ours.quat, quat_conj(data.xquat[1:]))
        assert float(quat_angle(twist).max()) < 1e-7
        for b in range(1, model.nbody):
            speed = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, b, speed, 0)
            np.testing.assert_allclose(ours.angvel[b - 1], speed[:3], atol=1e-9)
            np.testing.assert_allclose(ours.linvel[b - 1], speed[3:], atol=1e-9)


def test_toy_equals_mujoco():
    check_against_mujoco(make_humanoid(human(), generate_table(human())), 0)


@pytest.mark.parametrize(
    "name", ["cmu_amc/02/02_01.amc", "other/mass_bvh/walk.bvh", "deepmimic_txt/humanoid3d_walk.txt"]
)
def test_real_bodies_equal_mujoco(data_dir, name):
    check_against_mujoco(fit_humanoid(read_clip(data_dir / name))[0], 1)


def test_batches_and_dtypes():
    table = generate_table(human())
    qpos = fit_humanoid(swing())[1][0]
    one, many = Kinematics(table)(qpos[3]), Kinematics(table)(qpos.reshape(1, 31, -1))
    np.testing.assert_allclose(many.pos[0, 3], one.pos, atol=1e-7)
    assert many.quat.shape == (1, 31, len(table.rows), 4)
    kin, joints = Kinematics(table), len(Kinematics(table).hinged)
    for none in (qpos[:0], torch.tensor(qpos[:0])):
        assert kin(none).quat.shape == (0, len(table.rows), 4)
        assert kin.local_quats(none).shape == (0, joints, 4)
    single = Kinematics(table, "float32")(qpos)
    assert single.pos.dtype == np.float32
    np.testing.assert_allclose(single.pos.astype(float), many.pos[0], atol=2e-6, rtol=0)


def test_local_turns_are_the_hinges_turns():
    humanoid, motions, _ = fit_humanoid(swing())
    kin, qpos = Kinematics(humanoid.table), motions[0]
    local, world = kin.local_quats(qpos), kin(qpos).quat
    assert local.shape == (31, len(kin.hinged), 4)
    for k, row in enumerate(kin.hinged):
        r = humanoid.table.rows[row]
        rel = quat_mul(quat_conj(world[:, r.parent]), world[:, row])
        rest = np.broadcast_to(np.asarray(r.quat, dtype=float), (31, 4))
        turn = quat_mul(quat_conj(rest), rel)
        # Relative angles between two frames survive a change of axes.
        ours = quat_angle(quat_mul(local[5:, k], quat_conj(local[:-5, k])))
        twin = quat_angle(quat_mul(turn[5:], quat_conj(turn[:-5])))
        np.testing.assert_allclose(ours, twin, atol=1e-7, rtol=0)


def test_velocity_equals_mj_differentiate_pos():
    humanoid, motions, _ = fit_humanoid(swing(speed=1.0, bend=1.0))
    qpos, model = motions[0], humanoid.model
    ours = qpos_velocity(qpos, 30.0)
    for t in range(len(qpos)):
        a, b = max(t - 1, 0), min(t + 1, len(qpos) - 1)
        twin = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, twin, (b - a) / 30.0, qpos[a], qpos[b])
        np.testing.assert_allclose(ours[t], twin, atol=1e-9)


def test_velocity_ignores_the_quaternions_sign():
    qpos = fit_humanoid(swing(bend=1.0))[1][0]
    flipped = qpos.copy()
    flipped[::2, 3:7] *= -1
    np.testing.assert_allclose(qpos_velocity(flipped, 30.0), qpos_velocity(qpos, 30.0), atol=1e-9)


def test_lowest_points_are_those_of_the_shapes():
    humanoid = make_humanoid(human(), generate_table(human()))
    model, data = humanoid.model, mujoco.MjData(humanoid.model)
    rng = np.random.default_rng(3)
    for _ in range(5):
        data.qpos[:] = rng.standard_normal(model.nq)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        ours = lowest_height(humanoid.table, data.xpos[1:], data.xquat[1:])
        for g in range(1, model.ngeom):
            axes, size = data.geom_xmat[g].reshape(3, 3), model.geom_size[g]
            if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX:
                reach = float(np.abs(axes[2]) @ size)
            else:
                reach = float(size[0] + abs(axes[2, 2]) * size[1])
            low = data.geom_xpos[g, 2] - reach
            assert float(ours[model.geom_bodyid[g] - 1]) == pytest.approx(low, abs=1e-6)
