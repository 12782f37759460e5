"""What only the Warp backend does; what it shares with the others is in test_conformance.py."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from poise.sim import CpuBackend, NanGuard, SimConfig, UnstableError, WarpBackend
from poise.sim.warp_setup import (
    Capacity,
    capacity,
    check_driver,
    check_memory,
    check_torch_cuda,
    check_versions,
    resolve_device,
)
from refusals import refused
from warp_device import WARP_DEVICE, needs_warp

N = 4
CPU = torch.device("cpu")


def test_room_comes_from_the_model(make_spec):
    # A box and two capsules over a plane: 4 + 2 + 2 points on it, and 3 pairs among themselves.
    model = make_spec().compile()
    # Three pairs and three with the floor are fewer than 16; 8 + 3 contacts of 4 rows each.
    assert capacity(model) == Capacity(contacts=16, rows=44, convex=0)
    assert capacity(model, contacts=20) == Capacity(contacts=20, rows=80, convex=0)
    assert capacity(model, rows=7).rows == 7
    elliptic = make_spec(config=SimConfig(cone="elliptic")).compile()
    assert capacity(elliptic).rows == 33
    limited = make_spec()
    for joint in limited.joints[1:]:
        joint.limited, joint.range = 1, [-1, 1]
    assert capacity(limited.compile()).rows == 46
    with refused("out-of-range", says=("contacts_per_world", "0")):
        capacity(model, contacts=0)


def test_two_boxes_need_the_convex_search(make_spec):
    spec = make_spec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[1, 1, 0.1], pos=[3, 0, 0.1])
    assert capacity(spec.compile()).convex == 4


def test_bad_surroundings_are_told_in_a_sentence():
    with refused("unknown-device", says="gpu"):
        resolve_device("gpu")
    with refused("device-missing", says="cuda"):
        check_torch_cuda("cuda", None, 0)
    with refused("device-missing"):
        check_torch_cuda("cuda", "13.0", 0)
    check_torch_cuda("cuda", "13.0", 1)
    with refused("driver-unfit", says=("13.4", "12.2")):
        check_driver("1.19.0", 0, (13, 4), (12, 2))
    with refused("driver-unfit", says="without CUDA"):
        check_driver("1.19.0", 0, None, None)
    check_driver("1.19.0", 1, (13, 4), (13, 0))
    for pair in (("3.10.0", "4.0.0"), ("5.0.0", "4.0.0"), ("3.9.1", "3.9.1")):
        with refused("version-differs"):
            check_versions(*pair)
    check_versions("4.1.0", "4.0.0")


def test_too_many_worlds_are_told_how_many_fit():
    gib = 2**30
    check_memory(1000, gib // 1000, 2 * gib, CPU)
    check_memory(10**9, gib, None, CPU)
    with refused("out-of-memory", says=("8192", "8.0 GiB", "4.0 GiB", "3686")):
        check_memory(8192, gib // 1024, 4 * gib, CPU)


def test_a_missing_package_names_the_extra(monkeypatch, make_spec):
    monkeypatch.setitem(__import__("sys").modules, "mujoco_warp", None)
    with refused("extra-missing", says="poise-motion[gpu]"):
        WarpBackend(make_spec(), 1, "cpu")


@needs_warp
def test_landing_and_standing_are_those_of_the_cpu(make_spec):
    """A fall from 15 cm, the impact and two seconds of rest: the same places and contact forces.

    With a round friction cone; the pyramid's edges differ for steep capsules, see docs/index.md.
    """
    config = SimConfig(cone="elliptic")
    spec = make_spec(sensors=True, config=config)
    warp = WarpBackend(spec, 2, WARP_DEVICE, deterministic=True)
    cpu = CpuBackend(make_spec(sensors=True, config=config), 2)
    weight = 9.81 * float(cpu.model.body_mass.sum())
    most = 0.0
    for _ in range(60):
        warp.step(2)
        cpu.step(2)
        found, wanted = warp.contacts().cpu().double(), cpu.contacts()
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-3 * weight)
        torch.testing.assert_close(warp.state.xpos.cpu().double(), cpu.state.xpos, rtol=0, atol=2e-5)
        most = max(most, float(wanted.sum(1)[:, 2].max()))
    assert most > 1.3 * weight
    assert torch.equal(warp.state.qpos[0], warp.state.qpos[1])


@needs_warp
def test_a_bad_world_is_named_and_harms_no_other(make_spec, random_state):
    spec, other = (WarpBackend(make_spec(), N, WARP_DEVICE, deterministic=True) for _ in range(2))
    state = random_state(spec.model, N, height=0.45)
    for backend in (spec, other):
        backend.write(None, *state)
    spec.drive.ctrl[1] = torch.nan
    with pytest.raises(UnstableError) as caught:
        NanGuard(spec).step(2)
    failures = caught.value.failures
    other.step(2)
    assert [f.env for f in failures] == [1] and "ctrl of actuator 'hip_left'" in str(failures[0])
    assert spec.unstable().tolist() == [False, True, False, False]
    good = [0, 2, 3]
    assert torch.equal(spec.state.qpos[good], other.state.qpos[good])
    # Once written it moves like a world that never went bad.
    for backend in (spec, other):
        backend.write(torch.tensor([1]), state[0][:1], state[1][:1])
        backend.step(2)
    assert not spec.unstable().any()
    for name in ("qpos", "qvel", "xpos", "cvel"):
        assert torch.equal(spec.state[name], other.state[name])


@needs_warp
def test_overflow_is_an_error_and_not_a_wrong_result(make_spec, random_state):
    backend = WarpBackend(make_spec(), 2, WARP_DEVICE, constraints_per_world=5)
    qpos, qvel = random_state(backend.model, 2, height=0.1)
    backend.write(None, qpos, qvel)
    with refused("over-capacity", says=("world 0", "5")):
        backend.step(1)


@needs_warp
def test_model_fields_changed_after_a_capture_count(make_spec, random_state):
    """A captured graph holds addresses, and a field with a row per world has a new one."""
    backend = WarpBackend(make_spec(floor=False), 2, WARP_DEVICE)
    for _ in range(3):
        backend.step(1)
    backend.expand("opt.gravity")[1] = 0.0
    before = backend.state.qvel[:, 2].clone()
    for _ in range(3):
        backend.step(1)
    gain = (backend.state.qvel[:, 2] - before).cpu().numpy()
    np.testing.assert_allclose(gain, [-9.81 * 3 / 60, 0.0], atol=2e-2)


@needs_warp
def test_models_that_warp_cannot_step_are_refused(make_spec):
    spec = make_spec()
    spec.option.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
    with refused("physics-unsupported", says="RK4"):
        WarpBackend(spec, 1, WARP_DEVICE)
    with refused("out-of-memory", says="100000000"):
        WarpBackend(make_spec(), 10**8, WARP_DEVICE)
