"""The recovery table: what counts as back, and trials with a known outcome."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.control import PDTargets
from poise.env import Recovery, TaskConfig
from poise.env.recovery.falls import Drop
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.score import recovery_card, trial_task
from poise.score.recovered import KINDS, back_after
from refusals import refused
from toy_human import swing


@pytest.fixture(scope="module")
def built():
    task = build(ClipLibrary((swing(0.5),)), ResidualForce(num_envs=4, method="deepmimic"))
    small = Recovery(grace=2, drop=Drop(count=4, steps=60))
    return replace(task, task=trial_task(replace(task.task, recovery=small), falls=4))


class Still:
    """A policy that asks for nothing."""

    def __init__(self, actions: int):
        self.actions = actions

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(obs), self.actions)


class Carried(Still):
    """Sets all worlds on the reference after some control steps: each is back at a known time."""

    def __init__(self, env, after: list[int]):
        super().__init__(env.num_actions)
        self.env, self.after, self.step = env, torch.tensor(after), 0

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        env = self.env
        self.step = 1 if not env.age.any() else self.step + 1
        qpos, qvel = env.reference.coordinates(env.clip, env.frame)
        rows = (self.after <= self.step).nonzero().squeeze(-1)
        env.backend.write(rows, qpos[rows], qvel[rows])
        return super().act(obs)


def test_who_is_back_is_near_for_a_while():
    near = torch.tensor([[0, 1, 1, 0, 1, 1, 1], [1, 1, 1, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1, 1]]).bool()
    assert back_after(near, 3).tolist() == [5.0, 1.0, math.inf]
    assert back_after(near, 2).tolist() == [2.0, 1.0, 6.0]
    assert back_after(near, 9).tolist() == [math.inf] * 3


def test_a_trial_counts_those_who_came_back_in_time(built):
    made = []

    def make(n: int):
        made.append(built.env(n, 7, False, threads=1))
        return made[-1]

    class Late:
        def act(self, obs):
            if not hasattr(self, "inner"):
                # Four worlds: at once, after 4 and 13 steps of 1/30 s, and never.
                self.inner = Carried(made[0], [1, 4, 13, 99])
            return self.inner.act(obs)

    card = recovery_card(make, Late(), 4, seconds=(0.2, 0.5), held=0.1, method="carried", frame=3)
    assert [r.kind for r in card.rows] == list(KINDS)
    for row in card.rows:
        # Steps 1 and 4 end within 0.2 s (6 steps), step 13 within 0.5 s (15 steps).
        assert row.trials == 4 and row.within == (0.5, 0.75)
        assert row.slowest == pytest.approx(13 / 30) and row.median == pytest.approx(4 / 30)
    assert card.distance == (3.0, 3.0)


def test_a_policy_that_does_nothing_never_gets_up(built):
    card = recovery_card(
        lambda n: built.env(n, 0, False, threads=1), Still(len(built.humanoid.hinges)), 3,
        kinds=("fallen", "far"), seconds=(5.0,), at_once=2, method="still",
    )  # fmt: skip
    assert [r.within for r in card.rows] == [(0.0,), (0.0,)]
    data = json.loads(json.dumps(card.to_dict()))
    assert data["rows"][0]["median"] is None and data["rows"][0]["trials"] == 3


def test_the_same_seed_gives_the_same_trials_and_other_falls_than_training(built):
    def starts(seed: int, own: int) -> torch.Tensor:
        kept = []

        class Watch(Still):
            def act(self, obs):
                kept.append(env.backend.state.qpos.clone())
                return super().act(obs)

        env = built.env(2, own, False, threads=1)
        recovery_card(lambda n: env, Watch(len(built.humanoid.hinges)), 2, seconds=(0.1,), seed=seed)
        return torch.cat(kept)

    assert torch.equal(starts(1, 0), starts(1, 5)) and not torch.equal(starts(1, 0), starts(2, 0))


def test_what_cannot_be_tried_is_told(built):
    def make(n: int):
        return built.env(n, 0, False, threads=1)

    with refused("unknown-fall-state", says="lost"):
        recovery_card(make, Still(1), kinds=("lost",))
    with refused("index-outside", says="3"):
        recovery_card(make, Still(1), 2, clip=3)
    plain = replace(built, task=replace(built.task, recovery=None))
    with refused("task-unfit"):
        recovery_card(lambda n: plain.env(n, 0, False, threads=1), Still(1), 2)


def test_a_task_without_recovery_is_tried_as_the_papers():
    plain = TaskConfig((), (), (), PDTargets())
    asked = trial_task(plain).recovery
    assert asked == replace(Recovery.phc(), distance=(3.0, 3.0), drop=Drop(count=1000))
    published = (Path(__file__).resolve().parents[2] / "results/published.csv").read_text()
    assert all(f"{kind}; PHC," in published for kind in KINDS)
