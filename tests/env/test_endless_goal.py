"""Motion without end: what is lost is waited for, got up from, and gone on with."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.env.generator_goal import GeneratorGoal, Steering
from poise.env.recovery.recovering import FALLS, RETURNS, TRACKS, Recovering
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.recipes.imitation import Imitation
from toy_generator import Stands, endless_task


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def task(tracker: Tracker) -> Imitation:
    return endless_task(tracker)


def begun(task: Imitation, goal: Recovering) -> tuple[ImitationEnv, Tensor]:
    """An environment with its characters on the goal."""
    env = task.env(goal.num_envs, auto_reset=False, threads=1, help_scale=0.0)
    goal.reset(torch.arange(goal.num_envs))
    env.backend.write(None, *goal.start(None))
    env.age[:] = 0
    return env, env.set_goal(goal)


def test_a_character_that_is_knocked_over_gets_up_and_goes_on(tracker: Tracker, task: Imitation) -> None:
    assert tracker.recovery_clips is not None
    ease = tracker.recovery_clips.ease.double()
    motion = GeneratorGoal(Stands(ease), task.humanoid, 30.0, 2, lead=12)
    goal = Recovering(motion, tracker.recovery_clips)
    env, obs = begun(task, goal)
    for _ in range(20):
        obs = env.step(tracker.policy.act(obs)).final_obs
    assert goal.doing.tolist() == [TRACKS, TRACKS] and not goal.lost
    # As many frames are known as a controller looks ahead.
    assert bool((motion.count - motion.at > motion.lead).all())
    # The second one lies on its back a metre away.
    lying = env.backend.state.qpos.clone()
    up = tracker.recovery_clips.ups[0][0]
    lying[1] = up.to(lying)
    lying[1, :2] = ease[:2].to(lying) + torch.tensor([1.0, 0.5]).to(lying)
    still = torch.zeros_like(env.backend.state.qvel)
    env.backend.write(None, lying, still)
    obs = env.observe()
    assert goal.doing.tolist() == [TRACKS, FALLS] and [w for w, _ in goal.lost] == [1]
    # Its motion waits for it.
    at = int(motion.at[1])
    goal.advance(None, None)
    assert int(motion.at[1]) == at
    shot, done = None, set[int]()
    for _ in range(400):
        obs = env.step(tracker.policy.act(obs)).final_obs
        done.add(int(goal.doing[1]))
        if shot is None and int(goal.doing[1]) == RETURNS:
            shot = env.snapshot(), goal.ahead().clone()
        if goal.back:
            break
    # It rests at once, so it is led up in the next step.
    assert RETURNS in done and goal.back and goal.back[0][0] == 1
    assert goal.doing.tolist() == [TRACKS, TRACKS]
    # It stands where it got up, and the generator goes on from there.
    state = env.backend.state.qpos
    assert float(state[1, 2]) > 0.8 * float(ease[2])
    risen = state[1, :2].clone()
    for _ in range(60):
        obs = env.step(tracker.policy.act(obs)).final_obs
    assert len(goal.back) == 1 and len(goal.lost) == 1
    aims = goal.start(None)[0][1, :2]
    assert float((aims - env.backend.state.qpos[1, :2]).norm()) < 0.3
    assert float((aims - risen).norm()) < 0.05
    assert float((aims - lying[1, :2]).norm()) < 1.75
    # A snapshot in the middle of getting up is that again.
    assert shot is not None
    env.restore(shot[0])
    torch.testing.assert_close(goal.ahead(), shot[1])
    motion = GeneratorGoal(Stands(ease), task.humanoid, 30.0, 2, lead=12)
    again = Recovering(motion, tracker.recovery_clips)
    again.load_state(goal.state())
    assert torch.equal(again.doing, goal.doing) and torch.equal(again.at, goal.at)
    env.close()


def test_the_generator_may_see_what_was_done(tracker: Tracker, task: Imitation) -> None:
    assert tracker.recovery_clips is not None
    ease, seen = tracker.recovery_clips.ease.double(), list[Tensor]()

    class Keeps(Stands):
        def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
            seen.append(past.clone())
            return super().generate(past, ids, rng)

    motion = GeneratorGoal(Keeps(ease), task.humanoid, 30.0, lead=1, simulated=True)
    goal = Recovering(motion, None)
    goal.reset(torch.zeros(1, dtype=torch.long))
    goal.aim(None, None)
    pos, still = goal.layout.unpacked(goal.now()).pos, torch.zeros(1, len(task.humanoid.bodies), 3)
    did = list[Tensor]()
    for step in range(12):
        goal.advance(None, None)
        qpos = goal.start(None)[0].clone()
        qpos[:, 0] += 0.01 * step
        did.append(qpos[0])
        goal.watch(qpos, pos, still)
    # The first past was its own; the second ends with frames that are yet to be done.
    assert torch.equal(seen[0][0], ease.expand(5, -1)) and len(seen) > 1
    moved = seen[1][0, :, 0] - float(ease[0])
    assert float(moved[-1]) == 0 and float(moved[:-2].min()) > 0
    assert sorted(moved[:-2].tolist()) == moved[:-2].tolist()


def test_without_recovery_clips_a_character_stays_where_it_fell(
    tracker: Tracker, task: Imitation
) -> None:
    assert tracker.recovery_clips is not None
    motion = GeneratorGoal(Stands(tracker.recovery_clips.ease.double()), task.humanoid, 30.0)
    goal = Recovering(motion, None)
    env, _ = begun(task, goal)
    for _ in range(3):
        assert goal.watch(env.backend.state.qpos, env.pose().pos + 9.0, env.pose().linvel)
    assert int(goal.doing) == FALLS and len(goal.lost) == 1 and not goal.back
    env.close()


def test_a_get_up_that_is_lost_is_tried_in_another_way(tracker: Tracker, task: Imitation) -> None:
    clips = tracker.recovery_clips
    assert clips is not None
    motion = GeneratorGoal(Stands(clips.ease.double()), task.humanoid, 30.0, lead=1)
    goal = Recovering(motion, clips)
    goal.reset(torch.zeros(1, dtype=torch.long))
    goal.aim(None, None)
    lies, still = clips.ups[0][:1].clone(), torch.zeros(1, len(task.humanoid.bodies), 3)
    took = list[int]()
    for tries in range(3):
        goal.watch(lies, goal.layout.unpacked(goal.now()).pos + 2.0, still)
        assert goal.doing.tolist() == [FALLS] and goal.rows()["vain"].tolist() == [tries]
        goal.watch(lies, goal.layout.unpacked(goal.now()).pos + 2.0, still)
        assert goal.doing.tolist() == [RETURNS]
        took.append(int(goal.rows()["length"]))
    assert took[1] > took[0]
    # Once it is back, the next fall begins anew.
    while goal.doing.tolist() == [RETURNS]:
        goal.advance(None, None)
        goal.watch(goal.start(None)[0], goal.layout.unpacked(goal.now()).pos, still)
    assert goal.doing.tolist() == [TRACKS] and goal.rows()["vain"].tolist() == [0]


class Circles(Stands):
    """Proposes the past's last frame and, of each other future, a walk in another direction."""

    def __init__(self, pose: Tensor):
        super().__init__(pose)
        self.asked = 0

    def propose(
        self, past: Tensor, rng: torch.Generator, count: int, ids: Tensor, usual: int | None = None
    ) -> Tensor:
        self.asked += 1
        out = past[:, None, -1:].repeat(1, count, self.future, 1)
        angle = torch.linspace(0, 2 * torch.pi, count).double()
        step = 0.05 * torch.arange(1, self.future + 1).double()
        way = torch.stack((angle.cos(), angle.sin()), -1)[:, None] * step[:, None]
        out[..., :2] += way
        out[:, 0] = past[:, -1:]
        return out


def test_of_several_futures_the_nearest_is_done_and_thought_over_halfway(
    tracker: Tracker, task: Imitation
) -> None:
    assert tracker.recovery_clips is not None
    ease = tracker.recovery_clips.ease.double().clone()
    ease[:2] = 0.0
    made, still = Circles(ease), torch.zeros(1, len(task.humanoid.bodies), 3)
    points = ((1.5, 0.0), (1.5, 1.5))
    motion = GeneratorGoal(made, task.humanoid, 30.0, lead=1, steering=Steering(points))
    goal = Recovering(motion, None)
    goal.reset(torch.zeros(1, dtype=torch.long))
    goal.aim(None, None)
    assert int(motion.count) == made.past + made.future // 2
    for _ in range(75):
        goal.advance(None, None)
        qpos = goal.start(None)[0]
        goal.watch(qpos, goal.layout.unpacked(goal.now()).pos, still)
    # The character is where it is to be: the straight ways take 20 and 30 frames and a bit.
    assert [world for world, _ in goal.reached] == [0, 0] and goal.reached[-1][1] < 70
    assert made.asked > 12 and not goal.lost
