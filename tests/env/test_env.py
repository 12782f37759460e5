"""The imitation environment on the small human: starts, ends, seeds, exact continuation."""

from __future__ import annotations

import pytest
import torch

from poise.env import ImitationEnv
from poise.motion.rotations import axis_angle_to_quat, quat_mul, quat_rotate
from refusals import refused
from toy_human import swing


def actions(env: ImitationEnv, size: float = 0.1, seed: int = 0) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    return size * torch.randn(env.num_envs, env.num_actions, generator=rng)


def rollout(env: ImitationEnv, steps: int = 12) -> list[torch.Tensor]:
    out = [env.reset()]
    for t in range(steps):
        step = env.step(actions(env, seed=t))
        out += [step.obs.clone(), step.reward.clone(), step.terminated.clone(), step.final_obs.clone()]
    return out


def same(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def test_a_start_lies_exactly_on_the_reference(make_env):
    env = make_env(16)
    env.reset()
    state, rows = env.backend.state, env.reference.rows(env.clip, env.frame)
    assert torch.equal(state.qpos, env.reference.qpos[rows])
    assert torch.equal(state.qvel, env.reference.qvel[rows])
    assert len(env.frame.unique()) > 4 and int(env.frame.max()) < int(env.reference.length[0]) - 1
    view = env.view()
    for term in env.task.rewards:
        torch.testing.assert_close(term.fn(view, **term.params), torch.ones(16), atol=1e-3, rtol=0)
    for name in ("pos", "quat", "linvel", "angvel", "com", "heading"):
        a, b = getattr(view.sim, name), getattr(view.ref, name)
        sign = torch.where((a * b).sum(-1, keepdim=True) < 0, -1.0, 1.0) if a.shape[-1] == 4 else 1.0
        torch.testing.assert_close(a, b * sign, atol=2e-5, rtol=1e-4)
    env.close()


def test_a_start_in_a_later_cycle_is_carried_on(make_env):
    env = make_env(6, clips=(swing(1.0, speed=1.2, bend=0.7, cyclic=True, name="bend"),))
    clip, frame = torch.zeros(6, dtype=torch.long), torch.tensor([7, 37, 67, 30, 60, 0])
    env.reset_to(clip, frame)
    sim, ref, state = env.pose(), env.reference.gather(clip, frame), env.backend.state
    for name in ("pos", "linvel", "angvel", "com"):
        torch.testing.assert_close(getattr(sim, name), getattr(ref, name), atol=3e-5, rtol=1e-4)
    # Positions and velocities are those of frame 7, turned and moved by the cycle's step, in float64.
    turn, travel = env.reference.cycle_turn[0], env.reference.cycle_travel[0]
    assert state.qpos.dtype == torch.float64
    for k in (1, 2):
        pos = quat_rotate(turn, state.qpos[k - 1, :3]) + travel
        torch.testing.assert_close(state.qpos[k, :3], pos, atol=1e-12, rtol=0)
        lin = quat_rotate(turn, state.qvel[k - 1, :3])
        torch.testing.assert_close(state.qvel[k, :3], lin, atol=1e-12, rtol=0)
        torch.testing.assert_close(state.qvel[k, 3:], state.qvel[0, 3:], atol=1e-12, rtol=0)
    assert float((state.qpos[2, :2] - state.qpos[0, :2]).norm()) > 1.5
    # What the character sees and earns there is what it does in the first cycle.
    step = env.step(torch.zeros(6, env.num_actions))
    for a, b in ((0, 1), (0, 2), (5, 3), (5, 4)):
        torch.testing.assert_close(step.reward[a], step.reward[b], atol=1e-3, rtol=0)
        torch.testing.assert_close(step.final_obs[a], step.final_obs[b], atol=2e-2, rtol=0)
    env.close()


def test_reseeding_repeats_the_starts(make_env):
    env = make_env(16, seed=1)
    starts = []
    for seed in (5, 6, 5):
        before = env.frame.clone()
        env.reseed(seed)
        assert torch.equal(env.frame, before)
        env.reset()
        starts.append(env.frame.clone())
    assert torch.equal(starts[0], starts[2]) and not torch.equal(starts[0], starts[1])
    env.close()


def test_same_seed_same_numbers_at_any_thread_count(make_env):
    runs = []
    for seed, threads in ((3, 1), (3, 1), (3, 2), (4, 1)):
        env = make_env(6, seed=seed, threads=threads)
        runs.append(rollout(env))
        env.close()
    assert same(runs[0], runs[1]) and same(runs[0], runs[2])
    assert not same(runs[0], runs[3])


def test_state_continues_bit_for_bit(make_env):
    clips = (swing(0.5), swing(0.6, speed=1.0, cyclic=True, name="walk"))
    env, other = make_env(6, clips=clips, horizon=20), make_env(6, seed=9, clips=clips, horizon=20)
    rollout(env, 7)
    saved = {k: v.clone() for k, v in env.state().items()}
    other.load_state(saved)
    for t in range(25):
        a, b = env.step(actions(env, seed=t)), other.step(actions(env, seed=t))
        assert torch.equal(a.obs, b.obs) and torch.equal(a.reward, b.reward)
        assert torch.equal(a.final_obs, b.final_obs) and torch.equal(a.truncated, b.truncated)
    assert torch.equal(env.frame, other.frame)
    env.close()
    other.close()


def test_the_clips_end_finishes_and_the_horizon_is_a_time_out(make_env):
    env = make_env(2, auto_reset=False)
    env.reset_to(torch.tensor([0, 0]), torch.tensor([25, 0]))
    ends = [env.step(torch.zeros(2, env.num_actions)) for _ in range(5)]
    assert [bool(s.terminated[0]) for s in ends] == [False] * 4 + [True]
    # Done to its end is finished, not failed, and nothing is left to bootstrap.
    assert not ends[-1].terminated[1] and not any((s.truncated | s.failed).any() for s in ends)
    env.close()
    env = make_env(2, auto_reset=False, horizon=3)
    env.reset_to(torch.tensor([0, 0]), torch.tensor([0, 4]))
    out = [env.step(torch.zeros(2, env.num_actions)).truncated.tolist() for _ in range(3)]
    assert out == [[False, False], [False, False], [True, True]]
    env.close()


def test_a_fall_terminates_and_is_no_time_out(make_env):
    env = make_env(2, auto_reset=False, horizon=1)
    env.reset_to(torch.tensor([0, 0]), torch.tensor([0, 0]))
    qpos = env.backend.state.qpos.clone()
    qpos[0, 0] += 0.7  # Every body lies 0.7 m off: over the limit of 0.5 m.
    env.backend.write(None, qpos, env.backend.state.qvel.clone())
    step = env.step(torch.zeros(2, env.num_actions))
    assert step.terminated.tolist() == [True, False] and step.truncated.tolist() == [False, True]
    env.close()


def test_an_ended_world_begins_anew_and_the_others_go_on(make_env):
    env = make_env(3)
    env.reset_to(torch.zeros(3, dtype=torch.long), torch.tensor([29, 3, 10]))
    step = env.step(torch.zeros(3, env.num_actions))
    assert step.terminated.tolist() == [True, False, False] and not step.failed.any()
    assert env.age.tolist() == [0, 1, 1] and env.frame[1:].tolist() == [4, 11]
    assert not torch.equal(step.obs[0], step.final_obs[0])
    assert torch.equal(step.obs[1:], step.final_obs[1:])
    rows = env.reference.rows(env.clip, env.frame)
    assert torch.equal(env.backend.state.qpos[0], env.reference.qpos[rows][0])
    assert not env.action[0].any()
    env.close()


def test_the_callers_actions_stay_the_callers(make_env):
    env = make_env(3)
    env.reset_to(torch.zeros(3, dtype=torch.long), torch.tensor([29, 3, 10]))
    given = actions(env)
    before = given.clone()
    assert env.step(given).terminated.any() and torch.equal(given, before)
    env.close()


def test_observations_do_not_know_where_in_the_world(make_env):
    env = make_env(4)
    env.reset()
    for t in range(3):
        env.step(actions(env, seed=t))
    before = env.observe()
    # The whole world turns: the simulated characters and the reference alike.
    yaw, move = torch.tensor(1.9, dtype=torch.float64), torch.tensor([6.0, -3.0, 0.0]).double()
    q = axis_angle_to_quat(torch.tensor([0.0, 0, 1]).double(), yaw)

    def carried(qpos: torch.Tensor, qvel: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        qpos, qvel = qpos.clone(), qvel.clone()
        n = len(qpos)
        qpos[:, :3] = quat_rotate(q.expand(n, 4), qpos[:, :3]) + move
        qpos[:, 3:7] = quat_mul(q.expand(n, 4), qpos[:, 3:7])
        qvel[:, :3] = quat_rotate(q.expand(n, 4), qvel[:, :3])
        return qpos, qvel

    ref = env.reference
    qpos, qvel = carried(ref.qpos, ref.qvel)
    env.goal.clips.reference = ref.with_pose(ref.poser(qpos, qvel))
    env.goal.clips.reset(None, env.clip, env.frame)
    env.goal.aim(None, None)
    env.backend.write(None, *carried(env.backend.state.qpos, env.backend.state.qvel))
    torch.testing.assert_close(env.observe(), before, atol=1e-4, rtol=1e-4)
    env.close()


def test_two_clips_are_sampled_by_their_length(make_env):
    env = make_env(400, clips=(swing(1.0), swing(0.2, name="short")))
    env.reset()
    share = float((env.clip == 0).float().mean())
    assert share == pytest.approx(5 / 6, abs=0.07)
    assert int(env.frame[env.clip == 1].max()) == 5
    env.close()


def test_a_cyclic_clip_never_ends_but_by_the_horizon(make_env):
    env = make_env(2, clips=(swing(0.5, cyclic=True),), horizon=40, auto_reset=False)
    env.reset_to(torch.tensor([0, 0]), torch.tensor([0, 7]))
    for t in range(40):
        step = env.step(torch.zeros(2, env.num_actions))
        assert bool(step.truncated.any()) == (t == 39) or step.terminated.any()
    assert env.frame.tolist() == [40, 47]
    env.close()


def test_additive_and_absolute_actions_mean_the_same_targets(make_env):
    additive = make_env(3, auto_reset=False, method="deepmimic")
    absolute = make_env(3, auto_reset=False, method="deepmimic", action="absolute")
    clip, frame = torch.zeros(3, dtype=torch.long), torch.tensor([0, 5, 9])
    additive.reset_to(clip, frame)
    absolute.reset_to(clip, frame)
    small = actions(additive)
    rows = additive.reference.rows(additive.clip, additive.frame + 1)
    a = additive.step(small)
    b = absolute.step((small + additive.reference.qpos[rows, 7:]).float())
    torch.testing.assert_close(a.obs, b.obs, atol=1e-4, rtol=1e-4)
    additive.close()
    absolute.close()


@pytest.mark.parametrize("method", ["rfc-implicit", "rfc-explicit", "deepmimic"])
@pytest.mark.parametrize("reward", ["world", "local"])
def test_every_method_steps(make_env, method, reward):
    env = make_env(3, method=method, reward=reward)
    env.reset()
    step = env.step(actions(env, 0.3))
    assert step.obs.shape == (3, env.num_obs) and step.obs.dtype == torch.float32
    assert torch.isfinite(step.obs).all() and ((step.reward > 0) & (step.reward < 2)).all()
    assert not step.obs.requires_grad and not step.reward.requires_grad
    helped = method != "deepmimic"
    assert ("help/force_n" in step.log) == helped
    if helped:
        assert 0 < step.log["help/force_n"] <= 100.0 and "reward/residual" in step.log
    names = {f"reward/{t.name}" for t in env.task.rewards}
    assert names <= step.log.keys()
    total = sum(t.weight * env.terms[t.name] for t in env.task.rewards)
    torch.testing.assert_close(step.reward, total)
    env.close()


def test_help_lifts_the_character(make_env):
    heights = []
    for up in (0.0, 1.0):
        env = make_env(1, auto_reset=False, help_limit=900.0)
        env.reset_to(torch.zeros(1, dtype=torch.long), torch.zeros(1, dtype=torch.long))
        act = torch.zeros(1, env.num_actions)
        act[:, env.hinges + 2] = up
        for _ in range(8):
            step = env.step(act)
        assert step.log["help/force_n"] == pytest.approx(900.0 * up)
        heights.append(float(env.backend.state.subtree_com[0, 1, 2]))
        env.close()
    assert heights[1] > heights[0] + 0.05


def test_wrong_actions_are_told(make_env):
    env = make_env(2)
    with refused("wrong-shape", says="(2, 3)"):
        env.step(torch.zeros(2, 3))
    env.close()
