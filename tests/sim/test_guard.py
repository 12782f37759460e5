"""The NaN guard: it notices, names, keeps and replays, and changes nothing."""

from __future__ import annotations

import math

import pytest
import torch

from poise.sim import CpuBackend, Failure, NanGuard, UnstableError, replay_dump
from refusals import refused

LEFT = 6  # The left hip's degree of freedom.


@pytest.fixture
def backend(make_spec, random_state) -> CpuBackend:
    made = CpuBackend(make_spec(), 5, 2)
    made.write(None, *random_state(made.model, 5))
    return made


def test_it_changes_nothing(backend, make_spec, random_state):
    plain = CpuBackend(make_spec(), 5, 2)
    plain.write(None, *random_state(plain.model, 5))
    guard = NanGuard(backend)
    for _ in range(10):
        guard.step(2)
        plain.step(2)
    assert torch.equal(backend.snapshot(), plain.snapshot()) and guard.count == 10


@pytest.mark.parametrize(
    "field, index, part",
    [
        ("qfrc_applied", (3, LEFT), "joint 'hip_left' (body 'limb_left')"),
        ("xfrc_applied", (3, 3, 1), "body 'limb_right'"),
        ("ctrl", (3, 1), "actuator 'hip_right'"),
    ],
)
def test_a_nan_in_the_drive_is_named_and_replays(backend, tmp_path, field, index, part):
    guard = NanGuard(backend, tmp_path, where=lambda env: f"walk.bvh, clip frame {10 * env}", seed=8)
    guard.step(2)
    getattr(backend.drive, field)[index] = math.nan
    with pytest.raises(UnstableError) as caught:
        guard.step(2)
    text = str(caught.value)
    assert text.startswith("environment 3, control step 1, walk.bvh, clip frame 30: ")
    assert f"{field} of {part} became nan before the step began" in text
    (failure,) = caught.value.failures
    assert failure.env == 3 and str(failure.dump) in text
    replay = replay_dump(failure.dump)
    assert replay.exact and replay.cause.part == part and replay.info["seed"] == 8
    assert replay.description == str(failure) and replay.nstep == 2


def failures_of(guard: NanGuard, nstep: int) -> list[Failure]:
    """What a control step says of worlds that went bad."""
    try:
        guard.step(nstep)
    except UnstableError as error:
        return error.failures
    return []


def test_a_blow_up_within_the_step_is_seen_through_mujocos_reset(backend, tmp_path):
    guard = NanGuard(backend, tmp_path)
    others = [0, 1, 3, 4]
    assert failures_of(guard, 3) == []
    backend.drive.qfrc_applied[2, LEFT] = 1e14
    (failure,) = failures_of(guard, 3)
    # MuJoCo put the world back to its defaults, so the numbers now look sound.
    assert backend.state.qvel[2].abs().max() < 10 and backend.state.time[2] < backend.state.time[0]
    assert (failure.env, failure.cause.quantity, failure.cause.substep) == (2, "qfrc_applied", 0)
    assert backend.state.time[others].unique().numel() == 1
    backend.drive.qfrc_applied[2, LEFT] = 1e14
    assert len(failures_of(guard, 3)) == 1, "a second failure of the same world must show again"
    assert failures_of(guard, 3) == []
    assert replay_dump(failure.dump).exact


def test_a_force_that_is_too_large_is_traced_to_joint_and_physics_step(backend, tmp_path):
    guard = NanGuard(backend, tmp_path, speed_limit=60.0)
    backend.drive.qfrc_applied[1, LEFT] = 4e2
    failures = [f for _ in range(6) for f in failures_of(guard, 2)]
    first = failures[0]
    assert (first.env, first.cause.quantity, first.cause.unit) == (1, "qvel", "rad/s")
    assert "'hip_left'" in first.cause.part or "'root'" in first.cause.part
    assert abs(first.cause.value) > 60 and 1 <= first.cause.substep <= 2
    assert "rate_hz" in first.cause.hint
    assert replay_dump(first.dump).exact
    assert len(list(tmp_path.iterdir())) <= 4


def test_expanded_fields_travel_with_the_dump(backend, tmp_path):
    backend.expand("body_mass")[0, 1] = 11.0
    guard = NanGuard(backend, tmp_path, speed_limit=1e-9, max_dumps=1)
    first = failures_of(guard, 1)[0]
    replay = replay_dump(first.dump)
    assert first.env == 0 and replay.model.body_mass[1] == 11.0 and replay.exact
    assert replay.data.qpos[2] == pytest.approx(0.7)


def test_without_a_folder_nothing_is_saved(backend):
    guard = NanGuard(backend, speed_limit=1e-9)
    with refused("unstable", says="5 environments") as caught:
        guard.step(1)
    assert caught.value.failures[0].dump is None


def test_mistakes(backend, tmp_path):
    with refused("out-of-range", says="speed_limit"):
        NanGuard(backend, speed_limit=float("nan"))
    with refused("file-missing"):
        replay_dump(tmp_path / "none.safetensors")
