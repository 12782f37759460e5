"""Copies of worlds that try what a policy and small changes of it would do, and what each came to."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from poise.env.env import ImitationEnv
from poise.env.snapshot import Snapshot
from poise.env.task import Acts
from poise.kin.solids import shapes_of
from poise.metrics import has_lost
from poise.plan.prices import Roughness

#: What each control step costs in which a copy is lost.
LOSS = 100.0


class Changes(NamedTuple):
    """What N copies change of a policy's action pi: a_h = lerp(much pi(o_h) + offset_h, a_(h-1), keep).

    Attributes:
        offsets: `(N, H, A)` rad.
        keep: `(N, 1)`, share of the last action that actions keep, in place of the environment's own
            (`TaskConfig.filter`).
        much: `(N, 1)`, share of the policy's own action.
    """

    offsets: Tensor
    keep: Tensor
    much: Tensor


class Tried(NamedTuple):
    """What N copies of G worlds came to.

    Attributes:
        cost: `(N,)`, c = - sum_h gamma^h r_h - gamma^H V(o_H), and `LOSS` for each step that is lost.
        lost: `(N,)` bool, whether one was.
        ended: `(G,)` bool, whether a world's goal ended before the horizon.
        rough: how rough the copies were.
        source: how rough their goals were, `(G, ...)`.
        off: `(N, T, B)` m, how far each body was from its goal, from the first step on.
    """

    cost: Tensor
    lost: Tensor
    ended: Tensor
    rough: Roughness
    source: Roughness
    off: Tensor


class Candidates:
    """Simulates what is tried; N copies are of G worlds, N / G of each one after another.

    Args:
        copies: an environment of N worlds without ends and automatic restarts, with rewards
            (`Imitation.bare`).
        policy: acts on its observations.
        value: the return `(N,)` that the policy is still to earn, of observations `(N, O)`.
        discount: gamma.
    """

    def __init__(
        self,
        copies: ImitationEnv,
        policy: Acts,
        value: Callable[[Tensor], Tensor],
        discount: float,
    ):
        self.copies, self.policy, self.value, self.discount = copies, policy, value, discount
        humanoid = copies.goal.humanoid
        self._shapes, self._feet = shapes_of(humanoid.table, torch.float32), humanoid.feet
        self.steps = 0

    def tried(self, snapshot: Snapshot, changes: Changes, past: Tensor, groups: int = 1) -> Tried:
        """What the copies come to from a snapshot of one world or of N.

        Args:
            past: `(1 or N, k, B, 3)` m, the bodies in the frames before; with none nothing is kept of
                an action before the first.
            groups: G.
        """
        env, n = self.copies, self.copies.num_envs
        own = slice(None, None, n // groups)
        obs, start = env.restore(snapshot), env.pose()
        pos, quat = [start.pos.clone()], [start.quat.clone()]
        aim = env.goal_pose()
        ref_pos, ref_quat = [aim.pos[own].clone()], [aim.quat[own].clone()]
        cost, lost = torch.zeros(n), torch.zeros(n, dtype=torch.bool)
        ended = torch.zeros(groups, dtype=torch.bool)
        # Nothing came before the first action of an episode.
        keep = changes.keep * (env.age > 0).unsqueeze(1) if past.shape[1] else 0.0 * changes.keep
        factor = 1.0
        for offset in changes.offsets.unbind(1):
            # The last frame of a clip is a goal that is reached.
            ended |= env.goal.layout.place(env.goal.now()).end[own] > 0
            if bool(ended.all()):
                break
            action = torch.lerp(changes.much * self.policy.act(obs) + offset, env.action, keep)
            keep = changes.keep
            obs = env.step(env.unfiltered(action)).final_obs
            pose = env.pose()
            pos.append(pose.pos.clone())
            quat.append(pose.quat.clone())
            aim = env.goal_pose()
            ref_pos.append(aim.pos[own].clone())
            ref_quat.append(aim.quat[own].clone())
            lost |= has_lost(pose.pos, aim.pos)
            cost, factor = cost - factor * env.imitation + LOSS * lost, factor * self.discount
        cost = cost - factor * self.value(obs)
        self.steps += n * (len(pos) - 1)
        rough, source = (
            Roughness.of(
                torch.stack(p, 1), torch.stack(q, 1), was, self._shapes, self._feet, env.goal.rate_hz
            )
            for p, q, was in ((pos, quat, past), (ref_pos, ref_quat, past[:1, :0]))
        )
        each = n // groups
        aims = torch.stack(ref_pos[1:] or ref_pos, 1).repeat_interleave(each, 0)
        off = (torch.stack(pos[1:] or pos, 1) - aims).norm(dim=-1)
        return Tried(cost, lost, ended, rough, source, off)
