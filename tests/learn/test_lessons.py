"""A policy learns what a teacher says, beside PPO or alone, and goes on bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from test_trainer import TOY, assert_same
from torch import Tensor
from toy_point_env import PointEnv

from poise.learn import LessonConfig, Policy, Trainer
from refusals import refused


class Straight:
    """Points are to go straight to their targets."""

    def __init__(self, action: float = 1.0) -> None:
        self.rng, self.action = torch.Generator().manual_seed(0), action

    def teach(
        self, policy: Policy, value: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor, dict[str, float]]:
        obs = 2 * torch.rand(64, 4, generator=self.rng) - 1
        assert value(obs).shape == (64,) and policy.act(obs).shape == (64, 2)
        return obs, self.action * (obs[:, 2:] - obs[:, :2]), {"gain": 1.0}

    def state(self) -> dict[str, Tensor]:
        return {"rng": self.rng.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.rng.set_state(state["rng"])

    def close(self) -> None:
        pass


LESSONS = LessonConfig(kept=256, batches=20, batch=64, lr=1e-2)


def make(lessons: LessonConfig = LESSONS, action: float = 1.0) -> Trainer:
    return Trainer(PointEnv(32, 0), TOY, character="point", lessons=(Straight(action), lessons))


def test_a_policy_learns_what_the_teacher_says() -> None:
    trainer = make()
    rows = [trainer.iterate().row() for _ in range(30)]
    assert rows[-1]["update/lesson_loss"] < 0.01 < rows[1]["update/lesson_loss"]
    assert rows[0]["update/gain"] == 1.0 and rows[0]["update/labels"] == 64
    # The newest labels are kept.
    assert trainer.student is not None and len(trainer.student.state()["obs"]) == 256
    # PPO trained the critic alone.
    assert all(r["update/policy_grad_norm"] == 0 and r["update/value_loss"] > 0 for r in rows)


def test_ppo_may_train_the_policy_too() -> None:
    trainer = make(replace(LESSONS, reinforce=True))
    rows = [trainer.iterate().row() for _ in range(4)]
    assert rows[-1]["update/policy_grad_norm"] > 0 and rows[-1]["update/lesson_loss"] > 0


def test_it_goes_on_bit_for_bit(tmp_path) -> None:
    through, first, second = make(), make(), make()
    for _ in range(4):
        through.iterate()
    for _ in range(2):
        first.iterate()
    first.save(tmp_path / "x.safetensors")
    second.load(tmp_path / "x.safetensors")
    for _ in range(2):
        second.iterate()
    assert_same(through.state(), second.state())


def test_what_cannot_be_learned_is_told() -> None:
    with refused("training-diverged"):
        make(action=float("nan")).iterate()
    with refused("out-of-range"):
        LessonConfig(batch=0)
