"""A goal leads characters that have lost the reference back to it, and no others; and from one clip to
the next."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from poise.env import ImitationEnv, Reference
from poise.env.recovery.get_up import QUICK, RecoveryClips
from poise.env.recovery.planner import entry
from poise.env.recovery.recovering import FALLS, RETURNS, TRACKS, Recovering, RecoveryPhases
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build
from toy_library import PLAIN, lively, tiny


class Still:
    """A policy that asks for nothing."""

    def __init__(self, env: ImitationEnv):
        self.env = env

    def act(self, obs: Tensor) -> Tensor:
        return torch.zeros(self.env.num_envs, self.env.num_actions)


@pytest.fixture(scope="module")
def made() -> Imitation:
    return build(lively(), tiny(recovery=True, **PLAIN))


class Puppets:
    """Physics that put every character that does not fall where its goal is: a perfect tracker."""

    def __init__(self, env: ImitationEnv, goal: Recovering):
        self.env, self.goal = env, goal
        self.aside: torch.Tensor | None = None
        env.backend.step = self.step  # type: ignore[method-assign]

    def step(self, nstep: int = 1) -> None:
        s, falls = self.env.backend.state, (self.goal.doing == FALLS).unsqueeze(-1)
        qpos = torch.where(falls, s.qpos.double(), self.goal.start(None, 1)[0])
        if self.aside is not None:
            qpos[:, :2] += self.aside
            self.aside = None
        self.env.backend.write(None, qpos, torch.zeros_like(s.qvel.double()))


def test_a_character_that_is_moved_away_comes_back_and_goes_on(made: Imitation) -> None:
    env, own = made.bare().env(2, None, False, 1, help_scale=0.0, guard=False), made.reference
    clip = torch.tensor([own.names.index("walk")] * 2)
    env.reset_to(clip, torch.zeros_like(clip))
    assert made.recovery_clips is not None
    goal = Recovering(env.goal.clips, made.recovery_clips)
    env.set_goal(goal)
    world, seen, frames = Puppets(env, goal), [], []
    for step in range(400):
        seen.append(goal.doing.tolist())
        frames.append(goal.clips.frame.tolist())
        if step > 4 and seen[-1][0] == TRACKS and frames[-1][0] > frames[5][0] + 5:
            break
        world.aside = torch.tensor([[-1.0, 2.0], [0.0, 0.0]]) if step == 4 else None
        env.step(torch.zeros(2, env.num_actions))
    kinds = [k for (k, _), (before, _) in zip(seen[1:], seen, strict=False) if k != before]
    assert kinds == [FALLS, RETURNS, TRACKS] and goal.lost == [(0, 5)]
    # The other one is not touched: it goes on frame by frame, and stands where its clip ends.
    assert all(k == TRACKS for _, k in seen)
    assert [f for _, f in frames] == list(range(len(frames)))
    # The clip waited all the while, and went on with its own next frame.
    waited = [f for (f, _), (k, _) in zip(frames, seen, strict=True) if k == RETURNS]
    assert len(set(waited)) == 1 and waited[0] >= 5
    assert frames[-1][0] > waited[0] and torch.equal(env.clip, clip)
    assert torch.equal(env.goal_pose().pos, own.gather(clip, goal.clips.frame).pos)
    env.close()


def test_a_motion_is_entered_where_the_way_is_short(made: Imitation) -> None:
    """Of frames that are alike, that which is nearer is walked to: behind the walk an earlier one."""
    env, own = made.bare().env(1, None, False, 1, help_scale=0.0, guard=False), made.reference
    clip = own.names.index("walk")
    assert made.recovery_clips is not None
    goal = Recovering(env.goal.clips, made.recovery_clips)
    start, end = (own.coordinates(torch.tensor([clip]), torch.tensor([k]))[0][0] for k in (0, 10_000))
    way = end[:2] - start[:2]
    entered = []
    for there in (start[:2] - 5 * way, end[:2] + 5 * way):
        qpos = start.clone().double()
        qpos[:2] = there
        entered.append(entry(goal.get_up, own, clip, 1, qpos))
    assert entered[0] < entered[1]
    env.close()


def begun(made: Imitation) -> tuple[ImitationEnv, Tensor, RecoveryClips]:
    """One world at the start of the first clip, its row, and the recovery clips."""
    env = made.bare().env(1, None, False, 1, help_scale=0.0, guard=False)
    zero = torch.zeros(1, dtype=torch.long)
    env.reset_to(zero, zero)
    assert made.recovery_clips is not None
    return env, zero, made.recovery_clips


def test_a_character_that_loses_its_recovery_motion_gets_another_one(made: Imitation) -> None:
    env, zero, recovery_clips = begun(made)
    goal = Recovering(env.goal.clips, recovery_clips)
    qpos = env.backend.state.qpos.clone()
    qpos[:, 0] += 3.0
    env.backend.write(None, qpos, env.backend.state.qvel.clone())
    goal.lead(zero, env.backend.state.qpos)
    env.set_goal(goal)
    assert goal.doing.tolist() == [RETURNS] and not goal.lost
    world, doing = Puppets(env, goal), []
    # Pushed off the motion, it begins another from where it is.
    world.aside = torch.tensor([[0.0, 2.0]])
    for _ in range(4):
        env.step(torch.zeros(1, env.num_actions))
        doing.append(int(goal.doing))
    # It still stands, and needs no rest.
    assert doing == [RETURNS] * 4 and not goal.lost
    # The new motion lies at the end of the table, which drops those that no world is on.
    for tries in range(6):
        first, length = (int(goal.rows()[name]) for name in ("first", "length"))
        held = len(goal.shared()["packed"])
        assert held == first + length <= 4 * length and (first > 0 or tries)
        goal.lead(zero, env.backend.state.qpos)
    env.close()


def test_clips_are_done_one_after_another(made: Imitation) -> None:
    own = made.reference
    moved = own.qpos.clone()
    # The second clip begins 2 m aside of the first one's end, the third where the second ends.
    spans = [slice(int(a), int(a + n)) for a, n in zip(own.start, own.length, strict=True)][:3]
    for before, now, away in ((0, 1, (1.0, 2.0)), (1, 2, (0.0, 0.0))):
        gap = moved[spans[before].stop - 1, :2] - moved[spans[now].start, :2]
        moved[spans[now], :2] += gap + torch.tensor(away)
    still = moved[spans[1].stop - 1].repeat(20, 1)
    motions = [moved[spans[0]].numpy(), moved[spans[1]].numpy(), still.numpy()]
    chain = replace(made, reference=Reference(own.humanoid, motions, own.rate_hz, ["a", "b", "c"]))
    env, zero, recovery_clips = begun(chain)
    goal = Recovering(env.goal.clips, recovery_clips, chained=True)
    env.set_goal(goal)
    Puppets(env, goal)
    seen, ends = [], [len(m) - 1 for m in motions]
    for _ in range(600):
        seen.append((int(goal.doing), int(env.clip), int(goal.clips.frame)))
        if seen[-1] == (TRACKS, 2, ends[2]):
            break
        env.step(torch.zeros(1, env.num_actions))
    kinds = [k for k, before in zip(seen[1:], seen, strict=False) if k[:2] != before[:2]]
    assert kinds[0] == (RETURNS, 1, 0) and kinds[1] == (TRACKS, 1, 0)
    # What is at hand begins at once, and each clip is done frame by frame.
    assert kinds[2] == (TRACKS, 2, 0) and len(kinds) == 3 and not goal.lost
    assert [f for k, c, f in seen if (k, c) == (TRACKS, 1)] == list(range(ends[1]))
    # A copy that plans nothing stays at the end of its clip.
    env.set_goal(env.goal.clips)
    env.reset_to(zero, zero + ends[0] - 1)
    goal = Recovering(env.goal.clips, recovery_clips, chained=True, plans=False)
    env.set_goal(goal)
    Puppets(env, goal)
    for _ in range(3):
        env.step(torch.zeros(1, env.num_actions))
    assert goal.doing.tolist() == [TRACKS] and env.clip.tolist() == [0]
    env.close()


def test_who_has_lost_nothing_walks_to_the_next_clip_without_hurry(made: Imitation) -> None:
    env, zero, recovery_clips = begun(made)
    goal = Recovering(env.goal.clips, replace(recovery_clips, pace=QUICK), chained=True)
    qpos, ways = env.backend.state.qpos.clone().double(), {}
    qpos[:, 0] += 4.0
    # Who is led without a word hurries, whatever it did: so recovery is tried out.
    for calm in (True, False, None):
        goal.doing[:], goal.at[:] = TRACKS, 0
        goal.lead(zero, qpos, calm=None if calm is None else torch.tensor([calm]))
        length = int(goal.rows()["length"])
        way = torch.cat([goal.start(zero, later)[0][:, :2] for later in range(length)])
        ways[calm] = way.diff(dim=0).norm(dim=-1)
    assert len(ways[True]) > len(ways[False]) and ways[True].max() < 0.9 * ways[False].max()
    assert len(ways[None]) == len(ways[False])
    env.close()


def test_a_clip_that_is_not_come_back_to_goes_on(made: Imitation) -> None:
    env, _, recovery_clips = begun(made)
    goal = Recovering(env.goal.clips, recovery_clips, chained=True, returns=False)
    env.set_goal(goal)
    world = Puppets(env, goal)
    world.aside = torch.tensor([[2.0, 0.0]])
    env.step(torch.zeros(1, env.num_actions))
    assert goal.doing.tolist() == [TRACKS] and goal.clips.frame.tolist() == [1]
    env.close()


@pytest.mark.parametrize("hurries", [False, True])
def test_the_phases_of_a_fall_by_hand(hurries: bool) -> None:
    one, none = torch.tensor([True, False]), torch.zeros(2, dtype=torch.bool)
    fast, slow, first = torch.tensor([2.0, 0.1]), torch.tensor([0.1, 0.1]), torch.tensor([0])
    phases = RecoveryPhases(2, 30.0, "cpu", hurries)
    change = phases.watch(one, fast, one, none)
    assert change.lost.tolist() == [True, False] and not change.rests.any() and not change.back.any()
    assert phases.doing.tolist() == [FALLS, TRACKS]
    # It is waited for until it rests, or for 1.5 s; one in a hurry until it lies no more.
    assert phases.watch(none, fast, none, none).rests.tolist() == [hurries, False]
    assert phases.watch(none, slow, one, none).rests.tolist() == [True, False]
    waited = [bool(phases.watch(none, fast, one, none).rests[0]) for _ in range(44)]
    assert waited.index(True) == 42
    phases.return_by(first)
    change = phases.watch(one, slow, none, none)
    # What loses its recovery motion and stands needs no rest.
    assert change.lost[0] and change.rests[0] and phases.vain.tolist() == [1, 0]
    phases.return_by(first)
    assert phases.watch(none, slow, none, one).back.tolist() == [True, False]
    assert phases.doing.tolist() == [TRACKS, TRACKS] and not phases.vain.any()
