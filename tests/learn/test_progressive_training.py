"""PPO on columns and composers: what is frozen stays, runs go on bit for bit, files rebuild them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from torch import Tensor
from toy_point_env import PointEnv

from poise.learn import (
    LATEST,
    CloneConfig,
    PolicyBundle,
    PPOConfig,
    StepResult,
    Trainer,
    Until,
    WarmStart,
    clone,
    columns_of,
    compose,
    first_column,
    load_policy,
    next_column,
    primitive,
    run,
)
from poise.learn.primitives import count, primitive_log_std
from refusals import refused

TOY = PPOConfig(std=0.3, horizon=12, epochs=2, policy_hidden=(16,), value_hidden=(16,), minibatch=128)
OBS = torch.rand(50, 4, generator=torch.Generator().manual_seed(8)) * 2 - 1


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@cache
def stages_once(lateral: bool) -> PolicyBundle:
    start = "random" if lateral else "copy"
    second = train(next_column(first(lateral), start, generator=rng(1))).policy()
    return train(next_column(second, start, generator=rng(2))).policy()


def train(bundle: PolicyBundle, iterations: int = 2, **changes) -> Trainer:
    trainer = Trainer(PointEnv(32), replace(TOY, **changes), 0, "point", warm_start=bundle)
    for _ in range(iterations):
        trainer.iterate()
    return trainer


def first(lateral: bool = False) -> PolicyBundle:
    return train(first_column(4, 2, (16,), std=0.3, lateral=lateral, generator=rng())).policy()


def stages(lateral: bool = False) -> PolicyBundle:
    return stages_once(lateral).copy()


KINDS = {
    "column": lambda: stages(),
    "lateral": lambda: stages(True),
    "product": lambda: compose(stages(), weights="softplus", generator=rng(3)),
    "means": lambda: compose(stages(), "means", "relu", std=0.2, generator=rng(3)),
    "joint": lambda: compose(stages(), joint=True, generator=rng(3)),
}


@pytest.mark.parametrize("products", ["float32", "bfloat16"])
@pytest.mark.parametrize("kind", ["column", "lateral", "product", "means"])
def test_what_is_frozen_stays_bit_for_bit(kind, products):
    bundle = KINDS[kind]()
    before = bundle.state()
    trainer = train(bundle, 3, products=products)
    after = trainer.policy().state()
    learns = ("policy/mean.layers",) if kind in ("product", "means") else (
        "policy/mean.columns.2",
        "policy/mean.laterals.2",
    )  # fmt: skip
    changed = {k for k in before if not torch.equal(before[k], after[k])}
    assert changed == {k for k in before if k.startswith(learns)}
    # The earlier primitives act as before, whatever was learned.
    for k in range(2):
        one, other = primitive(bundle, k), primitive(trainer.policy(), k)
        assert torch.equal(one.act(OBS), other.act(OBS))


def test_everything_learns_together_where_it_shall():
    bundle = KINDS["joint"]()
    after = train(bundle, 1).policy().state()
    same = {k for k, v in bundle.state().items() if torch.equal(v, after[k])}
    assert same == {"policy/log_std", "policy/primitives.log_std"}


@pytest.mark.parametrize("kind", list(KINDS))
def test_resume_is_bit_exact_and_a_file_rebuilds_the_policy(kind, tmp_path):
    bundle = KINDS[kind]()

    def make(seed: int = 0) -> Trainer:
        return Trainer(PointEnv(32, seed), TOY, seed, "point", warm_start=bundle)

    run(make(), Until(iterations=4), tmp_path / "whole", tensorboard=False)
    run(make(), Until(iterations=2), tmp_path / "parts", tensorboard=False)
    result = run(make(7), Until(iterations=4), tmp_path / "parts", tensorboard=False)
    assert result.last is not None and result.last.iteration == 4
    whole, parts = (load_policy(tmp_path / x / LATEST, "point", 4, 2) for x in ("whole", "parts"))
    for name, value in whole.state().items():
        assert torch.equal(value, parts.state()[name]), name
    assert whole.shape == bundle.shape and whole.norm.fixed == (kind != "joint")
    trained = make()
    trained.load(tmp_path / "whole" / LATEST)
    assert torch.equal(whole.act(OBS), trained.policy().act(OBS))
    # What was loaded goes on learning as what was trained.
    again = Trainer(PointEnv(32), TOY, warm_start=whole)
    other = Trainer(PointEnv(32), TOY, warm_start=trained.policy())
    assert again.iterate().update == other.iterate().update
    # Another stage's checkpoint is refused.
    if kind != "column":
        with refused("checkpoint-unfit", says="policy"):
            Trainer(PointEnv(32), TOY, 0, "point", warm_start=first()).load(tmp_path / "whole" / LATEST)


def test_a_new_column_begins_where_its_source_stands():
    one = first()
    two = next_column(one, generator=rng(1))
    torch.testing.assert_close(two.act(OBS), one.act(OBS), rtol=0, atol=1e-6)
    assert not torch.equal(next_column(one, "random", generator=rng(1)).act(OBS), one.act(OBS))
    assert count(two) == 2 and not one.norm.fixed and two.norm.fixed
    plain = Trainer(PointEnv(32), TOY)
    plain.iterate()
    cloned = columns_of(plain.policy())
    assert torch.equal(cloned.act(OBS), plain.policy().act(OBS))
    with refused("no-primitives"):
        next_column(plain.policy(), generator=rng())
    with refused("policy-of-primitives"):
        columns_of(two)
    with refused("index-outside", says="2"):
        primitive(two, 2)
    with refused("policy-unfit", says="(4, 2)"):
        Trainer(Bandit(8), TOY, warm_start=two)


def test_every_primitive_keeps_the_noise_it_was_trained_with():
    one = first_column(4, 2, (8,), std=(0.1, 0.2), generator=rng())
    two = next_column(one, generator=rng())
    with torch.no_grad():
        two.policy.log_std.copy_(torch.tensor([0.4, 0.5]).log())
    whole = compose(two, generator=rng())
    want = torch.tensor([[0.1, 0.2], [0.4, 0.5]])
    for bundle in (two, whole, next_column(whole, generator=rng())):
        torch.testing.assert_close(primitive_log_std(bundle).exp()[:2], want)
    torch.testing.assert_close(whole.policy.log_std.exp(), want)
    torch.testing.assert_close(primitive(whole, 0).policy.log_std.exp(), want[0])


def test_a_critic_goes_on_in_the_next_stage():
    trainer = train(first_column(4, 2, (16,), std=0.3, generator=rng()))
    state = trainer.ppo.state()
    kept = {k: v for k, v in state.items() if k.startswith(("critic/", "return_norm/"))}
    start = WarmStart(next_column(trainer.policy(), generator=rng()), kept, trainer.samples)
    later = Trainer(PointEnv(32), TOY, warm_start=start)
    assert torch.equal(later.ppo.critic.last.weight, trainer.ppo.critic.last.weight)
    assert later.samples == trainer.samples and later.iterate().samples == 2 * 32 * 12 + 32 * 12


class ToTarget:
    """A teacher that walks to the target."""

    def act(self, obs: Tensor) -> Tensor:
        return obs[:, 2:] - obs[:, :2]


CLONE = CloneConfig(rounds=1, steps=20, epochs=(20, 10), minibatch=256, lr=1e-2, critic_steps=8)


@pytest.mark.parametrize("lateral", [False, True])
def test_a_teacher_teaches_only_what_is_not_frozen(lateral):
    bundle, wish = stages(lateral), ToTarget().act(OBS)

    def taught(start: PolicyBundle) -> PolicyBundle:
        warm, stats = clone(PointEnv(32), ToTarget(), CLONE, TOY, start=start)
        assert Trainer(PointEnv(32), TOY, warm_start=warm).iterate().samples > stats[-1].samples
        return warm.policy

    def changed(one: PolicyBundle, other: PolicyBundle) -> set[str]:
        a, b = one.state(), other.state()
        return {k for k in a if not torch.equal(a[k], b[k])}

    def error(b: PolicyBundle) -> float:
        return float((b.act(OBS) - wish).norm())

    column = taught(bundle)
    learns = "policy/mean.columns.2", "policy/mean.laterals.2"
    assert changed(bundle, column) == {k for k in bundle.state() if k.startswith(learns)}
    assert error(column) < 0.3 * error(bundle)
    # One of three primitives now does what the teacher does, and a composer is taught to choose it.
    for whole in (compose(column, generator=rng()), compose(column, "means", "relu", generator=rng())):
        composer = taught(whole)
        assert changed(whole, composer) == {k for k in whole.state() if "mean.layers" in k}
        assert error(composer) < 0.5 * error(whole), (error(composer), error(whole), error(column))


class Bandit(PointEnv):
    """One step per episode: the sign of the first observation says which of two actions is right."""

    num_obs, num_actions = 2, 1

    def _obs(self) -> Tensor:
        return self.p

    def step(self, actions: Tensor) -> StepResult:
        error = actions[:, 0] - self.p[:, 0].sign()
        done = torch.ones(self.num_envs, dtype=torch.bool)
        final = self._obs().clone()
        self._restart(done.nonzero().squeeze(-1))
        return StepResult(self._obs(), (-(error**2)).exp(), done, ~done, final, {"error": 0.0})


def worth(bundle: PolicyBundle, seed: int = 5) -> float:
    env = Bandit(4000, seed)
    obs = env.reset()
    return float(env.step(bundle.act(obs)).reward.mean())


@pytest.mark.parametrize(
    ("combine", "weights"), [("product", "softmax"), ("product", "softplus"), ("means", "relu")]
)
def test_the_composer_is_better_than_its_best_primitive(combine, weights):
    # Primitive 0 always does -0.9 and primitive 1 always +0.9: each is right on one side.
    bundle = next_column(first_column(2, 1, (8,), std=0.2, generator=rng()), generator=rng())
    net = bundle.policy.mean
    with torch.no_grad():
        for k, side in enumerate((-0.9, 0.9)):
            net.columns[k].last.weight.zero_()  # type: ignore[union-attr]
            net.columns[k].last.bias.fill_(side)  # type: ignore[union-attr]
    whole = compose(bundle, combine, weights, (16,), std=0.3, generator=rng(2))
    best = max(worth(primitive(whole, k)) for k in range(2))
    config = replace(TOY, horizon=8, policy_lr=5e-3, epochs=4, gamma=0.0)
    trainer = Trainer(Bandit(64), config, warm_start=whole)
    for _ in range(25):
        trainer.iterate()
    assert 0.4 < best < 0.6
    assert worth(trainer.policy()) > best + 0.3, (worth(trainer.policy()), best)


def test_the_noise_of_a_product_is_what_ppo_sees():
    bundle = KINDS["product"]()
    trainer = Trainer(PointEnv(32), TOY, warm_start=bundle)
    stats = trainer.iterate()
    rollout = trainer.rollout
    assert rollout.log_std is not None and rollout.log_std.shape == rollout.action.shape
    z = (rollout.action - rollout.mean) / rollout.log_std.exp()
    assert abs(float(z.mean())) < 0.1 and float(z.std()) == pytest.approx(1.0, abs=0.06)
    want = torch.distributions.Normal(rollout.mean, rollout.log_std.exp()).log_prob(rollout.action)
    torch.testing.assert_close(rollout.log_prob, want.sum(-1))
    assert stats.update.std == pytest.approx(float(rollout.log_std.exp().mean()))
    # Before the first gradient step old and new policy are the same, so the KL is tiny.
    assert 0 <= stats.update.kl < 0.2 and math.isfinite(stats.update.policy_loss)


def test_stages_of_old_files_are_read(tmp_path: Path):
    # A policy of before there were kinds has none in its shape.
    plain = PolicyBundle.make(4, 2, (8,), generator=rng())
    assert "kind" not in plain.shape
    plain.save(tmp_path / "p")
    assert torch.equal(load_policy(tmp_path / "p").act(OBS), plain.act(OBS))
    plain.shape["kind"] = "oracle"
    plain.save(tmp_path / "q")
    with refused("unknown-choice", says="oracle"):
        load_policy(tmp_path / "q")
