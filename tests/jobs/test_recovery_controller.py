"""A guide leads whoever has lost the reference back to it, and lets alone who has not."""

from __future__ import annotations

import pytest
import torch
from test_demonstrations import PLAIN, lively
from torch import Tensor

from poise.env import ImitationEnv
from poise.env.recovery.controller import FALLS, RETURNS, TRACKS, RecoveryController
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build
from toy_library import tiny


class Still:
    """A policy that asks for nothing."""

    def __init__(self, env: ImitationEnv):
        self.env = env

    def act(self, obs: Tensor) -> Tensor:
        return torch.zeros(self.env.num_envs, self.env.num_actions)


@pytest.fixture(scope="module")
def made() -> Imitation:
    return build(lively(), tiny(recovery=True, **PLAIN))


def puppets(env: ImitationEnv, controller: RecoveryController, aside: Tensor | None = None) -> None:
    """Everybody who does not fall is where the reference is: a perfect tracker."""
    qpos, qvel = env.reference.coordinates(env.clip, env.frame)
    s, falls = env.backend.state, (controller.doing == FALLS).unsqueeze(-1)
    qpos, qvel = torch.where(falls, s.qpos.double(), qpos), torch.where(falls, 0.0, qvel)
    if aside is not None:
        qpos[:, :2] += aside
        qvel = torch.zeros_like(qvel)
    env.backend.write(None, qpos, qvel)


def test_who_is_moved_away_comes_back_and_goes_on(made: Imitation) -> None:
    env, own = made.bare().env(2, None, False, 1, help_scale=0.0, guard=False), made.reference
    clip = torch.tensor([own.names.index("walk")] * 2)
    obs = env.reset_to(clip, torch.zeros_like(clip))
    assert made.recovery_clips is not None
    controller, seen, frames = RecoveryController(env, Still(env), made.recovery_clips), [], []
    last = int(own.length[clip[0]]) - 1
    for step in range(400):
        controller.act(obs)
        seen.append(controller.doing.tolist())
        frames.append(controller.frame.tolist())
        env.step(torch.zeros(2, env.num_actions))
        away = torch.tensor([[2.0, 1.0], [0.0, 0.0]]) if step == 4 else None
        puppets(env, controller, away)
        obs = env._observe()
        if step > 4 and int(controller.doing[0]) == TRACKS and int(env.frame[0]) > frames[5][0] + 5:
            break
    kinds = [k for (k, _), (before, _) in zip(seen[1:], seen, strict=False) if k != before]
    assert kinds == [FALLS, RETURNS, TRACKS] and controller.lost == [(0, 5)]
    # Nobody else is touched: it goes on frame by frame, and stands where its clip ends.
    assert all(k == TRACKS for _, k in seen)
    assert [f for _, f in frames] == list(range(len(frames)))
    assert int(env.clip[1]) == int(clip[1])
    # The reference waited all the while, and went on with its own next frame.
    waited = [f for (f, _), (k, _) in zip(frames, seen, strict=True) if k == RETURNS]
    assert len(set(waited)) == 1 and waited[0] >= 5
    assert frames[-1][0] > waited[0] and int(env.clip[0]) == int(clip[0])
    assert last > 0
    there = env.reference.gather(env.clip, env.frame)
    assert torch.equal(there.pos, own.gather(clip, env.frame).pos)
    env.close()


def test_who_loses_the_way_gets_another_one(made: Imitation) -> None:
    env = made.bare().env(1, None, False, 1, help_scale=0.0, guard=False)
    zero = torch.zeros(1, dtype=torch.long)
    env.reset_to(zero, zero)
    assert made.recovery_clips is not None
    controller = RecoveryController(env, Still(env), made.recovery_clips)
    puppets(env, controller, torch.tensor([[3.0, 0.0]]))
    obs = controller.lead(zero)
    assert controller.doing.tolist() == [RETURNS] and not controller.lost
    first = env.reference
    assert len(first.names) == len(made.reference.names) + 1
    # Pushed off the way, it waits for rest and begins another from where it is.
    puppets(env, controller, torch.tensor([[0.0, 2.0]]))
    doing = []
    for _ in range(4):
        controller.act(obs)
        doing.append(int(controller.doing))
        obs = env.step(torch.zeros(1, env.num_actions)).final_obs
        puppets(env, controller)
    assert doing[:2] == [FALLS, RETURNS] and env.reference is not first
    here = env.reference.coordinates(env.clip, zero)[0][0, :2]
    start = made.reference.coordinates(zero, zero)[0][0, :2] + torch.tensor([3.0, 2.0])
    assert (here - start).norm() < 0.1 and not controller.lost
    env.close()
