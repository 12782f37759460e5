"""Copies of a character try futures before it goes on with one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from poise.env.generator_goal import GeneratorGoal
from poise.env.recovery.recovering import Recovering
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.plan.rehearsal import FutureTrials, Rehearsal
from poise.recipes.imitation import Imitation
from toy_generator import Stands, endless_task


class Ways(Stands):
    """Flies off at 5 m/s first of all, and in some other future goes on with the last frame of its past;
    fps 30."""

    future = 20

    def __init__(self, pose: Tensor, stands: tuple[bool, ...]):
        super().__init__(pose)
        self.stands = torch.tensor(stands)

    def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        return self.propose(past, rng, 1, ids)[:, 0]

    def propose(
        self,
        past: Tensor,
        rng: torch.Generator,
        count: int,
        ids: Tensor | None = None,
        usual: int | None = None,
    ) -> Tensor:
        made = past[:, None, -1:].repeat(1, count, self.future, 1)
        flies = ~self.stands[torch.arange(count) % len(self.stands)]
        made[:, flies, :, 0] += torch.arange(1, self.future + 1) * 5.0 / 30.0
        return made


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def task(tracker: Tracker) -> Imitation:
    return endless_task(tracker)


def gone_about(
    tracker: Tracker, task: Imitation, stands: tuple[bool, ...], steps: int, tries: int
) -> tuple[Recovering, Rehearsal]:
    """The goal and the controller after some control steps; without recovery."""
    assert tracker.recovery_clips is not None
    ease = tracker.recovery_clips.ease.double()

    def goal(worlds: int, plans: bool) -> Recovering:
        motion = GeneratorGoal(Ways(ease, stands), task.humanoid, 30.0, worlds, lead=4, plans=plans)
        made = Recovering(motion, None, plans=plans)
        made.reset(torch.arange(worlds))
        return made

    own = goal(1, True)
    env = task.env(1, None, False, 1, help_scale=0.0)
    copies = task.bare().env(tries, None, False, 1, help_scale=0.0, guard=False)
    copies.set_goal(tried := goal(tries, False))
    acts = Rehearsal(tracker.policy, FutureTrials(tracker.policy, copies, tried.endless))
    acts.watch(env, own)
    env.backend.write(None, *own.start(None))
    env.age[:] = 0
    obs = env.set_goal(own)
    for _ in range(steps):
        obs = env.step(acts.act(obs)).final_obs
    env.close()
    copies.close()
    return own, acts


def test_a_future_that_a_copy_does_is_taken(tracker: Tracker, task: Imitation) -> None:
    goal, acts = gone_about(tracker, task, (False, False, True), 60, 3)
    assert not goal.lost and acts.chosen[0] == acts.chosen[2] == 0 and acts.chosen[1] >= 3
    # The first one is taken where it can be done.
    goal, acts = gone_about(tracker, task, (True, False), 30, 2)
    assert not goal.lost and acts.chosen[0] >= 2 and acts.chosen[1:] == [0, 0]


def test_where_none_can_be_done_the_way_is_short(tracker: Tracker, task: Imitation) -> None:
    goal, acts = gone_about(tracker, task, (False,), 12, 2)
    assert acts.chosen[:2] == [0, 0] and acts.chosen[2] >= 1
    motion = goal.endless
    # Fewer frames were taken than a future has, so that others are tried soon.
    assert int(motion.count[0]) < Ways.past + Ways.future


def test_what_is_no_motion_is_left_to_the_goal(tracker: Tracker, task: Imitation) -> None:
    assert tracker.recovery_clips is not None
    ease = tracker.recovery_clips.ease.double()
    motion = GeneratorGoal(Ways(ease, (True,)), task.humanoid, 30.0, 1, lead=4)
    motion.reset(torch.zeros(1, dtype=torch.long))
    motion.forget(0)
    assert motion.due() == [0]
    futures = motion.futures(0, 2)
    bad = replace(futures, made=futures.made * float("nan"))
    motion.choose(0, bad, 0, 20)
    assert motion.due() == [0]
    motion.choose(0, futures, 1, 7)
    assert motion.due() == []
    motion.aim(None, None)
    assert int(motion.count[0]) == Ways.past + 7


def test_copies_stand_where_a_past_ends(tracker: Tracker, task: Imitation) -> None:
    assert tracker.recovery_clips is not None
    past = tracker.recovery_clips.ease.double().repeat(Ways.past, 1)
    past[:, :2] += torch.tensor([3.0, -2.0])
    copies = task.bare().env(3, None, False, 1, help_scale=0.0, guard=False)
    motion = GeneratorGoal(Ways(past[0], (True,)), task.humanoid, 30.0, 3, lead=4, plans=False)
    motion.reset(torch.arange(3))
    copies.set_goal(motion)
    trials = FutureTrials(tracker.policy, copies, motion)
    ways = Ways(past[0], (False, False, True))

    def futures(k: int) -> Tensor:
        return ways.propose(past[None], torch.Generator(), 3)[0]

    found = trials.find(futures, partial(trials.stand, past))
    assert found[:4] == (0, 2, Ways.future, True)
    # It stood there, and does so again after it has gone elsewhere.
    assert float((copies.pose().pos[2, 0, :2] - past[0, :2].float()).norm()) < 0.1
    assert trials.find(futures, partial(trials.stand, past))[:4] == found[:4]
    copies.close()
