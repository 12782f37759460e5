"""PD targets by hand; the stable PD against naive loops, its fixed point and MuJoCo's servos."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
import torch

from poise.body import BodyConfig
from poise.control import PDTargets, stable_pd_torque
from poise.formats import read_clip
from poise.kinematics import fit_humanoid
from poise.motion import trim
from poise.sim import Drive, SimConfig
from refusals import refused


def test_targets_by_hand():
    action, ref = torch.tensor([[0.1, -0.2]]), torch.tensor([[1.0, 2.0]])
    drive = Drive.zeros(1, 2, 8, 2, torch.float32)
    PDTargets("additive", scale=0.5).apply(action, ref, drive)
    torch.testing.assert_close(drive.ctrl, torch.tensor([[1.05, 1.9]]))
    PDTargets("absolute", scale=2.0).apply(action, ref, drive)
    torch.testing.assert_close(drive.ctrl, torch.tensor([[1.25, 1.5]]))  # It adds.
    drive.clear()
    PDTargets("absolute", offset=torch.tensor([0.5, 0.5])).apply(action, ref, drive)
    torch.testing.assert_close(drive.ctrl, torch.tensor([[0.6, 0.3]]))
    with refused("unknown-choice", says=("mode", "relative")):
        PDTargets("relative")


def problem(nv: int = 8, n: int = 2, batch: int = 5) -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)

    def randn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    root = randn(batch, nv, nv)
    return {
        "mass": root @ root.transpose(-1, -2) + 2 * torch.eye(nv, dtype=torch.float64),
        "bias": randn(batch, nv),
        "kp": torch.tensor([50.0, 80.0], dtype=torch.float64),
        "kd": torch.tensor([5.0, 3.0], dtype=torch.float64),
        "q": randn(batch, n),
        "qvel": randn(batch, nv),
        "target": randn(batch, n),
        "limit": torch.tensor([1e9, 1e9], dtype=torch.float64),
    }


def test_targets_and_actions_lie_where_the_reference_does():
    """On a device that every build of torch knows, and that refuses to meet the CPU."""
    elsewhere = torch.zeros(3, 2, device="meta")
    pd = PDTargets("absolute", torch.ones(2), torch.zeros(2))
    assert pd.target(elsewhere, elsewhere).device == pd.action(elsewhere, elsewhere).device
    assert pd.action(elsewhere, elsewhere).device == elsewhere.device


def test_stable_pd_equals_a_naive_loop():
    p, dt = problem(), 0.01
    ours = stable_pd_torque(**p, dt=dt)
    for i in range(5):
        kp, kd = np.diag([0.0] * 6 + [50, 80]), np.diag([0.0] * 6 + [5, 3])
        error = np.concatenate([np.zeros(6), p["q"][i] + dt * p["qvel"][i, 6:] - p["target"][i]])
        mass, bias, vel = (p[k][i].numpy() for k in ("mass", "bias", "qvel"))
        acc = np.linalg.inv(mass + kd * dt) @ (-bias - kp @ error - kd @ vel)
        tau = -kp @ error - kd @ (vel + dt * acc)
        np.testing.assert_allclose(ours[i], tau[6:], atol=1e-9)


def test_stable_pd_is_its_own_fixed_point():
    # The torque, put into M q'' = tau - C, yields the very q'' that its damping term foresaw.
    p, dt = problem(), 0.01
    tau = stable_pd_torque(**p, dt=dt)
    full = torch.cat((torch.zeros(5, 6, dtype=torch.float64), tau), -1)
    acc = torch.linalg.solve(p["mass"], full - p["bias"])[:, 6:]
    vel = p["qvel"][:, 6:]
    twin = -p["kp"] * (p["q"] + dt * vel - p["target"]) - p["kd"] * (vel + dt * acc)
    torch.testing.assert_close(tau, twin)


def test_stable_pd_clips_at_the_limit():
    p = problem()
    free = stable_pd_torque(**p, dt=0.01)
    p["limit"] = torch.tensor([4.0, 0.5], dtype=torch.float64)
    clipped = stable_pd_torque(**p, dt=0.01)
    torch.testing.assert_close(clipped, torch.maximum(torch.minimum(free, p["limit"]), -p["limit"]))


def servo(
    model: mujoco.MjModel, start: np.ndarray, targets: np.ndarray, config: SimConfig
) -> np.ndarray:
    """Hinge angles `(T, n)` after each control step of MuJoCo's position servos."""
    config.apply(model)
    data = mujoco.MjData(model)
    data.qpos[:] = start
    out = []
    for target in targets:
        data.ctrl[:] = target
        for _ in range(config.substeps):
            mujoco.mj_step(model, data)
        out.append(data.qpos[7:].copy())
    return np.array(out)


def explicit(
    model: mujoco.MjModel, start: np.ndarray, targets: np.ndarray, config: SimConfig
) -> np.ndarray:
    """The same by `stable_pd_torque` on a model without servos and joint damping."""
    config.apply(model)
    kp, kd = model.actuator_gainprm[:, 0].copy(), model.dof_damping[6:].copy()
    limit = model.actuator_forcerange[:, 1].copy()
    model.dof_damping[:], model.actuator_gainprm[:], model.actuator_biasprm[:] = 0, 0, 0
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = start
    out = []
    gains = [torch.tensor(x) for x in (kp, kd)]
    for target in targets:
        for _ in range(config.substeps):
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, mass)
            bias = data.qfrc_bias - data.qfrc_constraint - data.qfrc_passive
            tau = stable_pd_torque(
                *(torch.tensor(x) for x in (mass, bias)), *gains,
                *(torch.tensor(x) for x in (data.qpos[7:], data.qvel, target)),
                config.timestep, torch.tensor(limit),
            )  # fmt: skip
            data.qfrc_applied[6:] = tau.numpy()
            mujoco.mj_step(model, data)
        out.append(data.qpos[7:].copy())
    return np.array(out)


@pytest.mark.parametrize("damping", [0.02, 0.2])
def test_coarse_servos_follow_the_papers_450_hz_controller(data_dir, damping):
    # Half a second of the CMU humanoid in the air, its servos following a walk. Measured: mean 0.28
    # degrees, 95th percentile 1.0, largest 2.6 (kd 0.02 kp); 0.37, 1.5 and 14 with the paper's 0.2 kp.
    clip = trim(read_clip(data_dir / "cmu_amc/02/02_01.amc"), 0, 80)
    humanoid, motions, _ = fit_humanoid(clip, BodyConfig(damping=damping), 30.0)
    start = motions[0][0].copy()
    start[2] += 2.0
    targets = motions[0][1:16, 7:]
    fine = explicit(copy.deepcopy(humanoid.model), start, targets, SimConfig(450.0, integrator="euler"))
    coarse = servo(copy.deepcopy(humanoid.model), start, targets, SimConfig(60.0))
    error = np.degrees(np.abs(fine - coarse))
    assert np.isfinite(error).all()
    assert error.mean() < 1.5 and np.quantile(error, 0.95) < 5.0
