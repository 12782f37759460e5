"""Cloning on the toy environment: what is learned, what is passed on, and that it repeats."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from toy_point_env import PointEnv

from poise.learn import CloneConfig, CloneStats, PPOConfig, Trainer, clone
from poise.learn.policy import WarmStart
from refusals import refused

SMALL = PPOConfig(
    horizon=8, policy_hidden=(32,), value_hidden=(32,), std=(0.1, 0.4), minibatch=256, value_lr=2e-3
)
QUICK = CloneConfig(steps=20, rounds=2, epochs=(20, 20), minibatch=128, critic_steps=20)


class Pusher:
    """Pushes the point straight to its target, with at most 1 per axis."""

    def __init__(self, env: PointEnv):
        self.env, self.calls = env, 0

    def act(self, obs: Tensor) -> Tensor:
        self.calls += 1
        assert torch.equal(obs, torch.cat([self.env.p, self.env.target], -1))
        return ((self.env.target - self.env.p) * 5).clamp(-1, 1)


def cloned(seed: int = 0, config: CloneConfig = QUICK, **more: object) -> tuple[WarmStart, PointEnv]:
    env = PointEnv(64, seed)
    return clone(env, Pusher(env), config, SMALL, seed, **more)[0], env  # type: ignore[arg-type]


def mean_reward(start: WarmStart | None, steps: int = 40) -> float:
    env = PointEnv(64, 9)
    obs, total = env.reset(), 0.0
    for _ in range(steps):
        action = Pusher(env).act(obs) if start is None else start.policy.act(obs)
        step = env.step(action)
        obs, total = step.obs, total + float(step.reward.mean())
    return total / steps


def test_the_clone_does_what_the_teacher_does() -> None:
    seen: list[CloneStats] = []
    start, _ = cloned(on_round=lambda s: seen.append(s))
    assert mean_reward(start) > mean_reward(None) - 0.02
    assert [s.round for s in seen] == [0, 1, 2]
    assert [s.samples for s in seen] == [1280, 2560, 3840] and start.samples == 3840 + 1280
    assert seen[-1].loss < seen[0].loss
    assert all(math.isnan(s.failure_rate) or 0 <= s.failure_rate <= 1 for s in seen)


def test_a_pass_may_take_a_part_of_all_samples() -> None:
    started = cloned(config=replace(QUICK, most=640, epochs=(60, 60)))[0]
    assert mean_reward(started) > mean_reward(None) - 0.03 and started.samples == 3840 + 1280


def test_the_same_seed_gives_the_same_bits_and_another_does_not() -> None:
    states = []
    for seed in (3, 3, 4):
        start, _ = cloned(seed)
        states.append({**start.policy.state(), **(start.critic or {})})
    assert all(torch.equal(states[0][k], states[1][k]) for k in states[0])
    assert any(not torch.equal(states[0][k], states[2][k]) for k in states[0])


def test_the_trainer_takes_over_policy_critic_and_cost() -> None:
    start, env = cloned()
    trainer = Trainer(env, SMALL, seed=5, warm_start=start)
    own = trainer.ppo.state()
    assert start.critic is not None and len(start.critic) > 4
    for name, value in {**start.policy.state(), **start.critic}.items():
        assert name == "policy/log_std" or torch.equal(own[name], value), name
    assert trainer.samples == start.samples and trainer.seconds == start.seconds
    stats = trainer.iterate()
    assert stats.samples == start.samples + stats.batch


def test_a_warm_critic_knows_the_returns_from_the_first_iteration() -> None:
    long = replace(QUICK, critic_passes=20)
    start, _ = cloned(config=long)
    warm = Trainer(PointEnv(64, 1), SMALL, 1, warm_start=start).iterate().update.explained_variance
    cold_start = WarmStart(start.policy)
    cold = Trainer(PointEnv(64, 1), SMALL, 1, warm_start=cold_start).iterate().update.explained_variance
    assert warm > 0.5 > cold


def test_the_critic_can_be_left_out() -> None:
    start, _ = cloned(config=replace(QUICK, critic_steps=0, rounds=0))
    assert start.critic is None and start.samples == 1280


def test_cloning_stops_when_it_is_told_to() -> None:
    env = PointEnv(64)
    _, stats = clone(env, Pusher(env), QUICK, SMALL, on_round=lambda s: False)
    assert len(stats) == 1


def test_the_teacher_drives_round_0_and_the_student_the_rest() -> None:
    """A teacher that always pushes out is obeyed in round 0 and only asked afterwards."""

    class Outward(Pusher):
        def act(self, obs: Tensor) -> Tensor:
            self.calls += 1
            return torch.ones_like(self.env.p)

    env = PointEnv(64)
    teacher = Outward(env)
    lazy = replace(QUICK, beta=0.0, epochs=(0, 0), critic_steps=0, rounds=1)
    _, stats = clone(env, teacher, lazy, SMALL)
    # Unfitted, the student hardly moves, so that none of its points leaves the field.
    assert stats[0].failure_rate > 0.5 and stats[1].failure_rate < 0.2
    assert teacher.calls == 40


class Half(Pusher):
    """Says nonsense on the left, where it knows that it knows nothing."""

    known = torch.zeros(0, dtype=torch.bool)

    def __init__(self, env: PointEnv):
        super().__init__(env)
        self.taught = list[Tensor]()

    def act(self, obs: Tensor) -> Tensor:
        wish = super().act(obs)
        self.known = self.env.p[:, 0] > 0
        self.taught.append(obs[self.known].clone())
        return torch.where(self.known[:, None], wish, -wish)


def test_nothing_is_learned_where_the_teacher_knows_nothing() -> None:
    env = PointEnv(64)
    teacher = Half(env)
    start, stats = clone(env, teacher, replace(QUICK, critic_steps=0), SMALL)
    kept, norm = torch.cat(teacher.taught), start.policy.norm
    assert (kept[:, 0] > 0).all() and 500 < len(kept) < 3500
    # The states that were learned from are those, to the last one.
    assert float(norm.count) == len(kept)
    torch.testing.assert_close(norm.mean, kept.double().mean(0), rtol=1e-6, atol=1e-9)
    # On the left nonsense is not obeyed: what is learned on the right is done there, too.
    obs = env.reset()
    left = env.p[:, 0] < 0
    wish = Pusher(env).act(obs)
    given = start.policy.act(obs)
    assert ((given * wish).sum(-1) > 0)[~left].float().mean() > 0.9
    assert ((given * wish).sum(-1) > 0)[left].float().mean() > 0.5
    # All steps count as seen.
    assert [s.samples for s in stats] == [1280, 2560, 3840]


def test_errors_are_said() -> None:
    with refused("out-of-range", says="steps"):
        CloneConfig(steps=0)
    with refused("out-of-range", says="beta"):
        CloneConfig(beta=2.0)

    class Broken(Pusher):
        def act(self, obs: Tensor) -> Tensor:
            return torch.full_like(self.env.p, math.nan)

    class Blank(Half):
        def act(self, obs: Tensor) -> Tensor:
            self.known = torch.zeros(8, dtype=torch.bool)
            return Pusher.act(self, obs)

    env = PointEnv(8)
    with refused("teacher-knows-nothing"):
        clone(env, Blank(env), QUICK, SMALL)
    with refused("training-diverged", says="teacher's action"):
        clone(env, Broken(env), QUICK, SMALL)
