"""A policy learns what a teacher would have done where it has come to itself, beside PPO or alone.

    min E |pi(o) - label(o)|^2  over the labels kept

A label is what the teacher said when it was given; older ones are of an older policy and are forgotten.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.ppo import PPO
from poise.learn.protocols import Lessons
from poise.learn.rollout import TrainingError
from poise.learn.state import (
    State,
    load_optimizer_state,
    make_generator,
    optimizer_state,
    prefixed,
    set_generator,
    take,
    under,
)
from poise.settings import validate


@dataclass(frozen=True)
class LessonConfig:
    """How labels are learned."""

    kept: int = 40_000
    """Labels that are kept, the newest ones."""
    batches: int = 8
    """Steps of Adam in an iteration."""
    batch: int = 1024
    """Labels of each."""
    lr: float = 5e-5
    """Adam's step size."""
    grad_norm: float = 1.0
    """Gradients are scaled down to this norm."""
    reinforce: bool = False
    """Whether PPO trains the policy, too; without, it trains the critic alone."""

    def __post_init__(self) -> None:
        validate(self)
        if min(self.kept, self.batches, self.batch) < 1 or min(self.lr, self.grad_norm) <= 0:
            what = "kept, batches and batch must be at least 1, lr and grad_norm above 0"
            raise PoiseError(what, "LessonConfig")


class Student:
    """Takes lessons: asks the teacher, keeps the labels, learns from them.

    Args:
        ppo: the policy that learns, and the critic by which the teacher looks ahead.
        lessons: the teacher.
        config: see `LessonConfig`.
        seed: of the draws.
    """

    def __init__(self, ppo: PPO, lessons: Lessons, config: LessonConfig, seed: int):
        self.ppo, self.lessons, self.config = ppo, lessons, config
        names = ppo.actor.policy.named_parameters()
        self._params = [p for name, p in names if p.requires_grad and name != "log_std"]
        self._adam = torch.optim.Adam(self._params, lr=config.lr, fused=True)
        self._draws = make_generator(seed, "lessons")
        self._obs = torch.zeros(0, ppo.actor.num_obs)
        self._action = torch.zeros(0, ppo.actor.num_actions)

    def learn(self) -> dict[str, float]:
        """Takes one more lesson and learns; numbers for the log.

        Raises:
            TrainingError: the loss is not finite.
        """
        c, actor = self.config, self.ppo.actor
        obs, action, log = self.lessons.teach(actor, self._value)
        self._obs = torch.cat((self._obs, obs))[-c.kept :]
        self._action = torch.cat((self._action, action))[-c.kept :]
        total, count = 0.0, len(self._obs)
        for _ in range(c.batches if count >= c.batch else 0):
            index = torch.randint(count, (c.batch,), generator=self._draws)
            error = self.ppo.mean(actor.norm.forward(self._obs[index])) - self._action[index]
            loss = error.square().sum(-1).mean()
            self._adam.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self._params, c.grad_norm, foreach=True)
            self._adam.step()
            total += float(loss.detach()) / c.batches
        if not total < float("inf"):
            raise TrainingError("the loss of the lessons is not finite", hint="Lower LessonConfig.lr")
        return {"lesson_loss": total, "labels": float(len(obs)), **log}

    @torch.no_grad()
    def _value(self, obs: Tensor) -> Tensor:
        return self.ppo.value(self.ppo.actor.norm.forward(obs))

    def state(self) -> State:
        """Copies of everything that a bit-exact continuation needs."""
        own = {"obs": self._obs.clone(), "action": self._action.clone()}
        kept = prefixed("adam", optimizer_state(self._adam)) | prefixed("teacher", self.lessons.state())
        return own | kept | {"draws": self._draws.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues from `state()`."""
        self._obs, self._action = take(state, "obs").clone(), take(state, "action").clone()
        load_optimizer_state(self._adam, under("adam", state))
        for group in self._adam.param_groups:
            group["lr"] = self.config.lr
        set_generator(self._draws, take(state, "draws"))
        self.lessons.load_state(under("teacher", state))
