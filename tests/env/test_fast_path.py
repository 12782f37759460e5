"""The fused step against the plain one: every pose, term and observation worked out the long way."""

from __future__ import annotations

import gc
import mmap
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from poise.env import ImitationEnv, RewardTerm, evaluate
from poise.env.evaluate import MANY, record
from poise.env.frame import Frame, LazyPose
from poise.motion.rotations import (
    euler_to_quat,
    heading_quat,
    quat_angle,
    quat_conj,
    quat_mul,
    quat_rotate_inv,
    quat_to_matrix,
)
from poise.sim import CpuBackend, body_linear_velocity_w
from toy_human import swing

#: MB that a recording's constant takes, more than what the C library keeps of what is freed, and how
#: many recordings are made and left.
CONSTANT_MB, RECORDINGS = 64, 5
CLIPS = (swing(0.6), swing(0.5, speed=1.0, bend=0.4, cyclic=True, name="walk"))


def actions(env: ImitationEnv, t: int) -> Tensor:
    rng = torch.Generator().manual_seed(t)
    return 0.2 * torch.randn(env.num_envs, env.num_actions, generator=rng)


def heading_frame(heading: Tensor, v: Tensor) -> Tensor:
    return quat_rotate_inv(heading[:, None].expand(*v.shape[:-1], 4), v)


def tilt(heading: Tensor, quat: Tensor) -> Tensor:
    return quat_mul(quat_conj(heading), quat)


def sixd(quat: Tensor) -> Tensor:
    m = quat_to_matrix(quat)
    return torch.cat((m[..., 0], m[..., 1]), -1)


def plain_observation(env: ImitationEnv) -> Tensor:
    """The default observation in float64, straight from the simulator and the reference."""
    state, ref = env.backend.state, env.reference
    ahead = ref.gather(env.clip, env.frame + 1)
    pos, quat, q = state.xpos[:, 1:], state.xquat[:, 1], state.qpos[:, 7:]
    heading = heading_quat(quat)
    linvel = body_linear_velocity_w(state, env.backend.model)[:, 1]
    parts = [
        pos[:, 0, 2:3], sixd(tilt(heading, quat)), quat_rotate_inv(heading, linvel),
        state.qvel[:, 3:6], q, state.qvel[:, 6:], ref.phase(env.clip, env.frame)[:, None].double(),
        heading_frame(heading, pos[:, 1:] - pos[:, :1]).flatten(1),
        ahead.qpos[:, 7:].double() - q, ahead.qvel[:, 6:].double(),
        quat_rotate_inv(heading, ahead.pos[:, 0].double() - pos[:, 0]),
        sixd(quat_mul(quat_conj(quat), ahead.quat[:, 0].double())),
        quat_rotate_inv(heading, ahead.linvel[:, 0].double()),
        heading_frame(heading, ahead.pos.double() - pos).flatten(1),
    ]  # fmt: skip
    return torch.cat(parts, -1)


def plain_rewards(env: ImitationEnv) -> dict[str, Tensor]:
    """The default imitation rewards in float64, joint by joint."""
    state, humanoid = env.backend.state, env.reference.humanoid
    ref = env.reference.gather(env.clip, env.frame)
    at, squares = 7, torch.zeros(env.num_envs, dtype=torch.float64)
    for row in humanoid.table.rows:
        if row.order:
            ours, theirs = (
                euler_to_quat(x[:, at : at + len(row.order)].double(), row.order)
                for x in (state.qpos, ref.qpos)
            )
            squares += quat_angle(quat_mul(ours, quat_conj(theirs))) ** 2
            at += len(row.order)
    speed = state.qvel[:, 6:] - ref.qvel[:, 6:]
    tips = list(humanoid.end_effectors)
    apart = state.xpos[:, 1:][:, tips] - ref.pos[:, tips]
    com = state.subtree_com[:, 1] - ref.com
    return {
        "pose": (-2 * squares).exp(),
        "velocity": (-0.005 * speed.square().sum(-1)).exp(),
        "end_effectors": (-5 * apart.square().sum((-1, -2))).exp(),
        "centre_of_mass": (-100 * com.square().sum(-1)).exp(),
    }


@pytest.mark.parametrize("settings", [{}, {"reward": "local", "method": "rfc-explicit"}])
def test_the_fused_step_equals_the_plain_one(make_env, settings):
    env = make_env(24, clips=CLIPS, horizon=9, **settings)
    env.reset()
    ended = 0
    for t in range(30):
        step = env.step(actions(env, t))
        over = step.terminated | step.truncated
        ended += int(over.sum())
        # Whether a world goes on or has just begun anew, it is seen as from nothing.
        torch.testing.assert_close(step.obs, env.observe(), atol=2e-6, rtol=2e-6)
        plain = plain_observation(env)
        torch.testing.assert_close(step.obs, plain.float(), atol=2e-5, rtol=2e-5)
        assert torch.equal(step.obs[~over], step.final_obs[~over])
    assert ended > 30
    env.close()


def test_rewards_and_last_observations_equal_the_plain_ones(make_env):
    env = make_env(16, clips=CLIPS, horizon=500, auto_reset=False)
    clip, frame = torch.arange(16) % 2, torch.arange(16) % 10
    env.reset_to(clip, frame)
    for t in range(8):
        step = env.step(actions(env, t))
        plain = plain_rewards(env)
        for name, value in plain.items():
            torch.testing.assert_close(env.terms[name], value.float(), atol=1e-5, rtol=1e-4)
        weights = {r.name: r.weight for r in env.task.rewards}
        total = sum(weights[name] * env.terms[name] for name in plain)
        torch.testing.assert_close(env.imitation, total)
        torch.testing.assert_close(step.reward, total + weights["residual"] * env.terms["residual"])
        torch.testing.assert_close(step.final_obs, plain_observation(env).float(), atol=2e-5, rtol=2e-5)
        means = {k: float(v.mean()) for k, v in plain.items()}
        assert {k: step.log[f"reward/{k}"] for k in means} == pytest.approx(means, abs=1e-4)
        assert step.log["imitation"] == pytest.approx(float(total.mean()), abs=1e-5)
    env.close()


def test_a_lazy_pose_makes_each_field_once_and_only_when_asked():
    made: list[str] = []

    def maker(name: str):
        def make() -> Tensor:
            made.append(name)
            return torch.zeros(1)

        return make

    pose = LazyPose(qpos=maker("qpos"), com=maker("com"))
    assert made == []
    assert pose.com is pose.com and made == ["com"]
    with pytest.raises(AttributeError):
        _ = pose.nothing  # type: ignore[attr-defined]
    frame = Frame.given(sim=pose, ref=pose, phase=torch.zeros(1))
    assert frame.sim.com is pose.com and made == ["com"]


def test_recorded_terms_give_what_the_plain_ones_give(make_task):
    task = make_task(*CLIPS, num_envs=20, horizon=9)
    fused, plain = (
        ImitationEnv(task.reference, CpuBackend(task.model, 20, 1), task.task, 2, 5, fused=on)
        for on in (True, False)
    )
    torch.testing.assert_close(fused.reset(), plain.reset())
    for t in range(25):
        a, b = fused.step(actions(fused, t)), plain.step(actions(plain, t))
        for name in ("obs", "final_obs", "reward", "terminated", "truncated"):
            torch.testing.assert_close(getattr(a, name), getattr(b, name), atol=1e-6, rtol=1e-6)
        assert a.log == pytest.approx(b.log, abs=1e-6)
    assert torch.equal(fused.backend.state.qpos, plain.backend.state.qpos)


def test_it_changes_no_bit_when_terms_are_recorded(make_task, monkeypatch):
    """At the first step, after some, in real time at once, or never."""
    task, made, runs = make_task(*CLIPS, num_envs=20, horizon=9), [], []
    monkeypatch.setattr(evaluate, "record", lambda *x: made.append(1) or record(*x))
    for often, soon, recordings in ((1, False, True), (7, False, True), (10**9, True, True),
                                    (10**9, False, False)):  # fmt: skip
        monkeypatch.setattr(evaluate, "OFTEN", often)
        made.clear()
        env = ImitationEnv(task.reference, CpuBackend(task.model, 20, 1), task.task, 2, 5)
        if soon:
            env.record_at_once()
        run = [env.reset().clone()]
        for t in range(15):
            step = env.step(actions(env, t))
            run += [
                step.obs.clone(),
                step.reward,
                step.terminated,
                step.truncated,
                step.final_obs.clone(),
            ]
        # What is observed, and what is judged.
        assert len(made) == 2 * recordings
        runs.append(run)
        env.close()
    for run in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(run, runs[0], strict=True))


def test_a_task_may_have_observations_alone(make_task):
    task = make_task()
    bare = replace(task.task, rewards=(), dones=())
    env = ImitationEnv(task.reference, CpuBackend(task.model, 3, 1), bare, 2)
    env.reset()
    step = env.step(actions(env, 0))
    assert step.obs.shape == (3, env.num_obs) and not step.reward.any() and not step.terminated.any()
    assert "judge" in env.recorded
    env.close()


@pytest.mark.parametrize("worlds", [3, MANY])
def test_what_a_step_gives_may_be_learned_from_with_gradients(make_task, worlds):
    task = make_task(num_envs=worlds)
    env = ImitationEnv(task.reference, CpuBackend(task.model, worlds, 1), task.task, 2)
    env.reset()
    for t in range(2):
        step = env.step(actions(env, t))
        given = [x for x in step if isinstance(x, Tensor)] + [*env.terms.values(), env.imitation]
        assert len(given) > 6 and not any(x.is_inference() for x in given)
    env.close()


def test_whole_slices_are_left_out_of_recordings_and_others_are_not():
    def plain(x: Tensor) -> tuple[Tensor, ...]:
        return x[:, 2:] + 1.0, x[1:, :, None], x[:, ::2]

    x = torch.arange(20.0).reshape(4, 5)
    recorded = record(plain, (x,))
    assert recorded != plain
    for given in (x, torch.cat((x, -x))):
        for a, b in zip(recorded(given), plain(given), strict=True):
            assert torch.equal(a, b)


def test_a_term_that_looks_at_values_is_never_frozen(make_task):
    def fickle(frame: Frame) -> Tensor:
        height = frame.sim.pos[:, 0, 2]
        return torch.ones_like(height) if float(frame.phase.max()) > 0.5 else torch.zeros_like(height)

    task = make_task()
    terms = replace(task.task, rewards=(RewardTerm("fickle", fickle, 1.0),), auto_reset=False)
    env = ImitationEnv(task.reference, CpuBackend(task.model, 1, 1), terms, 2)
    start = torch.zeros(1, dtype=torch.long)
    env.reset_to(start, start)
    rewards = [float(env.step(torch.zeros(1, env.num_actions)).reward) for _ in range(25)]
    assert rewards[:10] == [0.0] * 10 and rewards[-5:] == [1.0] * 5
    assert env.recorded == {"observe"}


@pytest.mark.parametrize("name", ["_create_graph_by_tracing", "_create_function_from_graph"])
def test_without_torchs_inner_parts_functions_run_as_they_are(monkeypatch, name) -> None:
    monkeypatch.delattr(f"torch._C.{name}")

    def plain(x: Tensor) -> tuple[Tensor, ...]:
        return (x[:, 2:] * 2.0,)

    x = torch.arange(8.0).reshape(2, 4)
    assert record(plain, (x,)) is plain


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux's /proc")
def test_recordings_that_are_left_leave_no_memory_behind() -> None:
    """An environment's recordings hold its reference; a folder of clips makes many environments."""

    def held_mb() -> float:
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE / 2**20

    def record_one() -> None:
        table = torch.rand(CONSTANT_MB, 2**18)

        def plain(x: Tensor) -> tuple[Tensor, ...]:
            return (x + table[:, :3].sum(),)

        x = torch.rand(3)
        recorded = record(plain, (x,))
        assert recorded is not plain
        torch.testing.assert_close(recorded(x)[0], plain(x)[0], rtol=0, atol=0)

    # What torch remembers, and what the allocator keeps, is the same after some more.
    for _ in range(RECORDINGS):
        record_one()
    before = held_mb()
    for _ in range(RECORDINGS):
        record_one()
    # torch remembers what it made ready last.
    assert held_mb() - before < 1.5 * CONSTANT_MB
