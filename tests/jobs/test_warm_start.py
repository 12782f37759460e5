"""How a run starts: expert, clone, first checkpoint, and the way on from each of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.jobs import warm_start
from poise.jobs.runs import train
from poise.jobs.warm_start import (
    TrainingCallbacks,
    finetuning,
    score_expert,
    some_starts,
    start_training,
)
from poise.learn import LATEST, PolicyBundle, PPOConfig, Trainer, Until, WarmStart, load_policy
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.score import ScoreCard
from poise.sim import UnstableError
from toy_human import swing

SMALL = PPOConfig(horizon=4, epochs=2, policy_hidden=(16,), value_hidden=(16,), policy_lr=3e-4)


@pytest.fixture(scope="module")
def task() -> Imitation:
    return build(ClipLibrary.of(swing()), ResidualForce(num_envs=16, ppo=SMALL, seed=3))


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Trainer]]:
    """All trainers that a test makes; their worlds are freed at the end."""
    trainers: list[Trainer] = []
    original = Imitation.trainer

    def trainer(self: Imitation, *args: object, **more: object) -> Trainer:
        trainers.append(original(self, *args, **more))  # type: ignore[arg-type]
        return trainers[-1]

    monkeypatch.setattr(Imitation, "trainer", trainer)
    yield trainers
    for one in trainers:
        one.env.close()


def test_the_clone_is_the_first_checkpoint(task: Imitation, tmp_path: Path, made: list[Trainer]) -> None:
    cards: list[ScoreCard] = []
    clones: list[tuple[PolicyBundle, WarmStart, bool]] = []
    tell = TrainingCallbacks(
        expert=cards.append,
        cloned=lambda p, s: clones.append((p, s, (tmp_path / LATEST).exists())),
    )
    trainer = start_training(task, tmp_path, 1, tell)
    assert cards[0].method == "expert" and cards[0].episodes == 1
    policy, start, was_saved = clones[0]
    assert was_saved and trainer.iteration == 0 and trainer.samples == start.samples > 0
    saved = load_policy(tmp_path / LATEST)
    obs = torch.randn(5, policy.num_obs)
    assert torch.equal(saved.act(obs), policy.act(obs))


def test_going_on_keeps_the_settings_and_clones_no_more(
    task: Imitation, tmp_path: Path, made: list[Trainer]
) -> None:
    start_training(task, tmp_path, 1)
    again = start_training(
        task, tmp_path, 1, TrainingCallbacks(expert=lambda card: pytest.fail("cloned twice"))
    )
    assert again.config == made[0].config and again.config.policy_lr == 1e-4
    again.load(tmp_path / LATEST)
    a, b = made[0].state(), again.state()
    assert not [k for k in a if not torch.equal(a[k].nan_to_num(), b[k].nan_to_num())]


def test_without_an_expert_ppo_starts_from_nothing(task: Imitation, tmp_path: Path) -> None:
    plain = replace(task, config=replace(task.config, expert=False))
    result = train(plain, tmp_path, Until(iterations=1), threads=1, tensorboard=False)
    assert result.last is not None and result.last.samples == 4 * 16


def test_an_expert_that_fails_is_done_without(
    task: Imitation, tmp_path: Path, made: list[Trainer], monkeypatch: pytest.MonkeyPatch
) -> None:
    def thrown_off(*args: object) -> None:
        raise UnstableError([])

    monkeypatch.setattr(warm_start, "clone_expert", thrown_off)
    monkeypatch.setattr(UnstableError, "__init__", lambda self, failures: None)
    monkeypatch.setattr(UnstableError, "__str__", lambda self: "the knee")
    said: list[str] = []
    trainer = start_training(task, tmp_path, 1, TrainingCallbacks(failed=said.append))
    assert said == ["the knee"] and trainer.samples == 0 and trainer.config == task.ppo()
    trainer.save(tmp_path / LATEST)
    # What goes on from it keeps the settings of a start from nothing.
    assert start_training(task, tmp_path, 1).config == task.ppo()


def test_finetuning_takes_small_steps_and_spares_the_policy_first() -> None:
    ppo = finetuning(PPOConfig(policy_lr=3e-4))
    assert ppo.policy_lr == 1e-4 and ppo.critic_warmup > 0
    assert finetuning(PPOConfig(policy_lr=5e-5, critic_warmup=9)).critic_warmup == 9


def test_a_first_look_takes_few_frames(task: Imitation) -> None:
    longer = build(ClipLibrary.of(swing(2.0)), ResidualForce())
    clip, frame = some_starts(longer, 7)
    assert len(clip) == 7 and frame[0] == 0 and bool((frame.diff() > 0).all())
    assert score_expert(task).help.limit_n == 100
