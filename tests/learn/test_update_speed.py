"""What makes an update fast changes nothing that matters."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from toy_point_env import PointEnv

from poise.learn import PPOConfig, Trainer
from poise.learn import parallel as threaded_update
from poise.learn.networks import RunningNorm
from refusals import refused

SMALL = PPOConfig(std=0.3, horizon=24, epochs=1, policy_hidden=(8,), value_hidden=(8,), minibatch=256)


def test_moments_say_what_observing_says():
    rng = torch.Generator().manual_seed(0)
    slow, fast = RunningNorm(6), RunningNorm(6)
    scale = torch.tensor([1.0, 10.0, 0.01, 1.0, 100.0, 0.0])
    for k in range(4):
        x = torch.randn(500, 6, generator=rng) * scale + 3.0 * scale + 1.0
        slow.observe(x)
        if k == 0:
            fast.observe(x)
            slow.freeze()
            fast.freeze()
            continue
        y, moments = fast.normalise(x)
        assert torch.equal(y, slow(x))
        fast.add(len(x), moments)
    torch.testing.assert_close(fast.mean, slow.mean, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(fast.m2, slow.m2, rtol=1e-5, atol=1e-9)
    assert fast.count == slow.count


@pytest.mark.parametrize("products", ["float32", "bfloat16"])
@pytest.mark.parametrize("worth", [1, threaded_update.WORTH])
def test_training_side_by_side_changes_no_number(products, worth, monkeypatch):
    monkeypatch.setattr(threaded_update, "WORTH", worth)
    config = replace(SMALL, epochs=3, critic_warmup=1, products=products)
    states = []
    for threads in (1, 2):
        trainer = Trainer(PointEnv(32, 0), config, seed=1, update_threads=threads)
        for _ in range(3):
            trainer.iterate()
        states.append(trainer.state())
    first, other = states
    assert all(torch.equal(first[k], other[k]) for k in first if k != "trainer/counters")


def test_a_minibatch_in_two_parts_has_the_gradient_of_one(monkeypatch):
    grads = []
    for worth in (1, threaded_update.WORTH):
        monkeypatch.setattr(threaded_update, "WORTH", worth)
        # An odd number of rows, so that the parts are of different sizes.
        config = replace(SMALL, products="float32", minibatch=10**6, policy_lr=1e-9, horizon=7)
        trainer = Trainer(PointEnv(33, 0), config, seed=1)
        trainer.iterate()
        grads.append([p.grad.clone() for p in trainer.ppo.actor.policy.parameters() if p.requires_grad])
    for split, whole in zip(*grads, strict=True):
        torch.testing.assert_close(split, whole, rtol=1e-4, atol=1e-7)


def test_a_failure_in_the_second_part_is_told_and_no_thread_goes_on():
    param = torch.nn.Parameter(torch.ones(1))

    def loss_and_terms(index):
        if int(index[0]) > 0:
            raise ValueError("second part")
        return (param * index.float()).sum(), torch.zeros(1)

    parts = torch.arange(4).tensor_split(2)
    with pytest.raises(ValueError, match="second part"):
        threaded_update.mean_gradient(
            parts, [param], loss_and_terms, threaded_update.ThreadedUpdate(), True
        )
    assert param.grad is None


def test_bfloat16_products_learn_as_well():
    rewards = {}
    for products in ("float32", "bfloat16"):
        config = replace(SMALL, std=0.4, policy_lr=3e-3, epochs=5, products=products)
        trainer = Trainer(PointEnv(64, 0), config, seed=1)
        rewards[products] = [trainer.iterate().reward for _ in range(40)][-5:]
    low, half = (sum(r) / 5 for r in rewards.values())
    assert low > 0.5 and half == pytest.approx(low, abs=0.06)


def test_unknown_products_are_told():
    with refused("unknown-choice", says=("products", "float8")):
        PPOConfig(products="float8")  # type: ignore[arg-type]
