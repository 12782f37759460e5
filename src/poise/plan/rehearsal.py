"""Rehearsal: before more motion is made for a character, copies of it try several futures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from poise.machine import one_thread
from poise.metrics import has_lost

if TYPE_CHECKING:
    from poise.env.env import ImitationEnv, Snapshot
    from poise.env.generator_goal import Futures, GeneratorGoal
    from poise.env.recovery.recovering import Recovering
    from poise.env.task import Acts

#: m of mean distance from a future within which a copy does it, and at its end, since from farther off
#: it would not go on well.
NEAR_M, END_M = 0.25, 0.15
#: Times that futures are drawn until one is done.
ROUNDS = 8
#: Frames before a copy has lost a future that are left out where no copy does one, and the fewest kept.
SAFE, FEWEST = 15, 10


class Rehearsal:
    """Acts as another controller does, after it has chosen among futures of a generator; `watch` tells
    it which environment it acts in.

    A kinematic policy knows nothing of balance. Whenever more frames of a character's motion are needed,
    copies of the character as it stands each follow one of several futures by the policy alone, and the
    first in the generator's own order is taken whose copy stays within `NEAR_M` and ends within `END_M`:
    motions that can be done are as likely as they were. If no copy does, more are drawn, whatever label
    the world keeps to; in the end the one that is followed for longest is taken, up to shortly before it
    is lost.

    Args:
        acts: the controller.
        policy: acts in the copies.
        copies: an environment of the same body and kind of goal, of as many worlds as futures are tried:
            without ends and automatic restarts (`Imitation.bare`).
        tried: what the copies follow, a generator that makes no frames there.

    Attributes:
        chosen: how often the generator's first future was taken, another one, and one that is lost.
    """

    def __init__(self, acts: Acts, policy: Acts, copies: ImitationEnv, tried: Recovering):
        self.acts, self.policy, self.copies, self.tried = acts, policy, copies, tried.endless
        self.chosen = [0, 0, 0]
        self._env: ImitationEnv | None = None
        self._goal: GeneratorGoal | None = None
        self._begun = set[int]()

    def watch(self, env: ImitationEnv, goal: Recovering) -> None:
        """Chooses in the worlds of `env`, which follow `goal`, from now on."""
        self._env, self._goal, self._begun = env, goal.endless, set()

    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for observations `(N, O)` of the worlds as they stand."""
        if self._goal is not None and self._env is not None:
            if bool((self._env.age == 0).any()):
                self.begin()
                obs = self._env.observe()
            for world in self._goal.due():
                self._choose(world, self._goal)
        return self.acts.act(obs)

    def begin(self) -> list[int]:
        """Chooses in worlds that are yet to make their first step, since frames that they know were made
        before anything could be tried. Gives those in which no copy does a future; they may be chosen
        for again."""
        goal, env = self._goal, self._env
        assert goal is not None and env is not None
        fresh = [w for w in (env.age == 0).nonzero().squeeze(-1).tolist() if w not in self._begun]
        stuck = list[int]()
        for world in fresh:
            goal.forget(world)
            stuck += [world] if not self._choose(world, goal) else []
        self._begun |= set(fresh) - set(stuck)
        goal.aim(None, None)
        return stuck

    @one_thread()
    def _choose(self, world: int, goal: GeneratorGoal) -> bool:
        assert self._env is not None
        snapshot = self._env.snapshot(torch.tensor([world]))
        known, best = int(goal.count[world] - 1 - goal.at[world]), None
        for k in range(ROUNDS):
            # The label that the world keeps to counts once.
            futures = goal.futures(world, self.copies.num_envs, wished=k == 0)
            which, lasts, done = self._tried_out(snapshot, futures, world, goal)
            if done:
                goal.choose(world, futures, which, goal.keeps)
                self.chosen[0 if k == which == 0 else 1] += 1
                return True
            if best is None or lasts > best[2]:
                best = futures, which, lasts
        assert best is not None
        futures, which, lasts = best
        self.chosen[2] += 1
        goal.choose(world, futures, which, max(FEWEST, min(goal.keeps, lasts - known - SAFE)))
        return False

    def _tried_out(
        self, snapshot: Snapshot, futures: Futures, world: int, goal: GeneratorGoal
    ) -> tuple[int, int, bool]:
        """The index of the future to be taken, for how many control steps from now on a copy does it,
        and whether that is all."""
        copies = self.copies
        copies.restore(snapshot)
        every = torch.arange(copies.num_envs)
        # Frames that a copy's own goal may have made are no part of it.
        self.tried.count[:], self.tried.low[:] = goal.count[world], goal.low[world]
        self.tried.extend(every, futures.made[every % len(futures), : goal.keeps])
        self.tried.aim(None, None)
        obs = copies.observe()
        steps = int(self.tried.count[0] - self.tried.at[0]) - 2
        lasts, off = torch.full((len(every),), steps), torch.zeros(len(every))
        for k in range(steps):
            obs = copies.step(self.policy.act(obs)).final_obs
            pos, aim = copies.pose().pos, copies.goal_pose().pos
            off = (pos - aim).norm(dim=-1).mean(-1).nan_to_num(torch.inf)
            lost = has_lost(pos, aim) | (off > NEAR_M)
            lasts = torch.where(lost & (lasts == steps), k, lasts)
            if bool((lasts < steps).all()):
                break
        steady = (lasts == steps) & (off <= END_M)
        which = int(steady.float().argmax()) if bool(steady.any()) else int(lasts.argmax())
        return which % len(futures), int(lasts[which]), bool(steady[which])
