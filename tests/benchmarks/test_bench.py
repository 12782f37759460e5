"""The benchmarks measure what they say, on a small human and for moments only."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.common.machine import Clock, machine
from benchmarks.suites.engine import (
    Raw,
    StablePDBackend,
    bench_engine,
    bench_latency,
    bench_physics,
    exploring,
    record,
)
from benchmarks.suites.gpu import bench_gpu
from poise.jobs.runs import begin, train
from poise.learn import PPOConfig, Until
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from toy_human import swing
from warp_device import WARP_DEVICE, needs_warp

SMALL = PPOConfig(
    horizon=4, minibatch=64, epochs=2, norm_warmup=2, policy_hidden=(16,), value_hidden=(16,), std=0.05
)


@pytest.fixture(scope="module")
def imitation() -> Imitation:
    return build(swing(), ResidualForce(num_envs=16, ppo=SMALL))


def test_the_raw_limit_steps_the_very_states_of_the_environment(imitation):
    env = imitation.env(4, threads=1)
    env.reset()
    states = record(env, exploring(imitation, env, 3))
    assert len(states) == 3 and "step" not in vars(env.backend)
    raw = Raw(env, 1)
    assert raw.seconds(states) > 0
    # Nothing was reset in between, so the last raw step ends where the environment stands.
    np.testing.assert_array_equal(raw.batch.qpos, env.backend.state.qpos.numpy())
    np.testing.assert_array_equal(raw.batch.xpos, env.backend.state.xpos.numpy())
    env.close()


def test_engine_splits_the_time_into_phases(imitation):
    told: list[str] = []
    # Enough steps that a process beside it does not double the time of one of them.
    result = bench_engine(imitation, threads=1, repeats=3, steps=12, tell=told.append)
    assert told == ["engine, 1 of 3", "engine, 2 of 3", "engine, 3 of 3"]
    phases = result["training_phases"]
    assert set(phases) == {"physics", "terms", "policy", "update"} and min(phases.values()) > 0
    assert sum(phases.values()) == pytest.approx(1.0, abs=0.1)
    assert result["envs"] == 16 and result["threads"] == 1 and result["rate_hz"] == 60.0
    for name in ("raw", "raw_without_derived", "stepping", "training"):
        assert result[f"{name}_per_s"] > 0
    assert 0 < result["stepping_of_raw"] < 1.5
    json.dumps(result, allow_nan=False)


@needs_warp
def test_gpu_measures_against_mujoco_warps_own_step(imitation):
    result = bench_gpu(imitation, 4, WARP_DEVICE, repeats=1, steps=2)
    assert result["envs"] == 4 and result["constraints_per_world"] > 100
    for name in ("raw", "stepping", "training"):
        assert result[f"{name}_per_s"] > 0
    json.dumps(result, allow_nan=False)


def test_latency_counts_policy_physics_and_the_rest(imitation):
    result = bench_latency(imitation, steps=40)
    assert set(result["phases_ms"]) == {"physics", "policy", "observation"}
    assert sum(result["phases_ms"].values()) == pytest.approx(result["ms"], abs=0.01)
    assert 0 < result["ms"] <= result["ms_95"]


def test_a_clock_leaves_no_trace():
    class Thing:
        def work(self) -> int:
            return 3

    thing, clock = Thing(), Clock()
    with clock.on(thing, "work", "work"):
        assert thing.work() == 3
        assert clock.read()["work"] > 0 and clock.read() == {"work": 0.0}
    assert vars(thing) == {}


def test_stable_pd_moves_like_servos_with_damped_joints(imitation):
    fine = build(swing(), ResidualForce(sim=replace(imitation.config.sim, rate_hz=450.0)))
    model, reference = fine.model, fine.reference
    model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
    paper = StablePDBackend(model, 2, 1)
    inertia = np.zeros((model.nv, model.nv))
    data = mujoco.MjData(model)
    data.qpos[:] = reference.qpos[3].numpy()
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    paper.write(None, reference.qpos[3:5], reference.qvel[3:5] * 0)
    torch.testing.assert_close(paper.inertia()[0], torch.tensor(inertia))
    servos = fine.env(2, auto_reset=False, threads=1).backend
    servos.write(None, reference.qpos[3:5], reference.qvel[3:5])
    paper.write(None, reference.qpos[3:5], reference.qvel[3:5])
    for backend in (servos, paper):
        for _ in range(6):
            backend.drive.ctrl.copy_(reference.qpos[3:5, 7:])
            backend.step(15)
    apart = (servos.state.qpos[:, 7:] - paper.state.qpos[:, 7:]).abs().max()
    assert float(apart) < 0.1 and not paper.drive.qfrc_applied.any()


def test_physics_scores_one_policy_on_every_kind(tmp_path: Path):
    config = ResidualForce(num_envs=16, ppo=SMALL)
    made = begin(tmp_path, ClipLibrary.of(swing(1.2)), config)
    train(made, tmp_path, Until(iterations=1), threads=1, tensorboard=False)
    rows = bench_physics(tmp_path, stable_pd=True, starts=3)
    assert [(r["physics"], r["rate_hz"]) for r in rows] == [
        ("trained", 60.0), ("fine", 450.0), ("stable PD", 450.0),
    ]  # fmt: skip
    for r in rows:
        assert r["episodes"] == 3 and 0 <= r["succ"] <= 1 and r["mpjpe_mm"] > 0 and 0 < r["reward"] <= 1


def test_the_machine_is_stated():
    facts = machine()
    assert facts["cores"] >= 1 and {"torch", "mujoco", "poise", "load_before"} <= facts.keys()
