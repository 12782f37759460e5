"""The adapter for rsl_rl: its protocol, and one iteration of its own runner."""

from __future__ import annotations

import sys
from typing import Any

import pytest
import torch

from poise.env.faces import GROUP, RslRlVecEnv
from refusals import refused


@pytest.fixture
def adapted(make_env) -> Any:
    pytest.importorskip("tensordict")
    env = RslRlVecEnv(make_env(5))
    yield env
    env.close()


def test_it_has_what_the_protocol_names(adapted) -> None:
    protocol = pytest.importorskip("rsl_rl.env").VecEnv
    for name in (*protocol.__annotations__, *protocol.__abstractmethods__):
        assert hasattr(adapted, name), name


def test_steps_are_the_environments(make_env) -> None:
    pytest.importorskip("tensordict")
    torch.manual_seed(0)
    adapted, twin = RslRlVecEnv(make_env(5, horizon=12)), make_env(5, horizon=12)
    obs = adapted.get_observations()
    assert obs.batch_size == (5,) and torch.equal(obs[GROUP], twin.reset())
    cut = finished = 0
    for _ in range(40):
        action = 0.1 * torch.randn(5, adapted.num_actions)
        obs, reward, done, extras = adapted.step(action)
        out = twin.step(action)
        assert torch.equal(obs[GROUP], out.obs) and torch.equal(reward, out.reward)
        assert done.dtype == torch.int64 and torch.equal(done.bool(), out.terminated | out.truncated)
        assert torch.equal(extras["time_outs"], out.truncated)
        # Where a clip was done to its end there is nothing left to bootstrap.
        assert not extras["time_outs"][out.terminated].any()
        assert extras["log"]["/imitation"] == out.log["imitation"]
        assert torch.equal(adapted.episode_length_buf, twin.age)
        assert torch.equal(adapted.get_observations()[GROUP], obs[GROUP])
        cut += int(out.truncated.sum())
        finished += int((out.terminated & ~out.failed).sum())
    assert cut and finished
    adapted.close()
    twin.close()


def test_returned_tensors_are_not_used_again(adapted) -> None:
    zero = torch.zeros(5, adapted.num_actions)
    obs, reward, _, _ = adapted.step(zero)
    kept = obs[GROUP].clone(), reward.clone()
    adapted.step(zero + 0.1)
    assert torch.equal(obs[GROUP], kept[0]) and torch.equal(reward, kept[1])


def test_random_ages_bring_time_outs_forward(adapted) -> None:
    adapted.episode_length_buf = torch.full((5,), adapted.max_episode_length - 1)
    _, _, done, extras = adapted.step(torch.zeros(5, adapted.num_actions))
    assert done.all() and extras["time_outs"].all() and (adapted.episode_length_buf == 0).all()


def test_rsl_rls_runner_learns_an_iteration(adapted) -> None:
    runners = pytest.importorskip("rsl_rl.runners")
    network = {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu"}
    noise = {"class_name": "GaussianDistribution", "init_std": 0.1}
    config = {
        "num_steps_per_env": 4,
        "save_interval": 1000,
        "obs_groups": {"actor": [GROUP], "critic": [GROUP]},
        "algorithm": {"class_name": "PPO", "num_mini_batches": 2, "num_learning_epochs": 2},
        "actor": {**network, "obs_normalization": True, "distribution_cfg": noise},
        "critic": {**network, "obs_normalization": True},
    }
    runner = runners.OnPolicyRunner(adapted, config)
    before = [p.detach().clone() for p in runner.alg.actor.parameters()]
    runner.learn(2, init_at_random_ep_len=True)
    after = list(runner.alg.actor.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert all(bool(torch.isfinite(p).all()) for p in after)
    # The worlds can go on outside of the runner's inference mode.
    adapted.reset()
    adapted.env.step(torch.zeros(5, adapted.num_actions))


def test_mistakes_are_told(make_env, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_env(2, auto_reset=False)
    with refused("auto-reset-needed"):
        RslRlVecEnv(env)
    env.close()
    monkeypatch.setitem(sys.modules, "tensordict", None)
    env = make_env(2)
    with refused("extra-missing", says="poise-motion[rsl-rl]"):
        RslRlVecEnv(env)
    env.close()
