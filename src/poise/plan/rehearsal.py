"""Rehearsal: before more motion is made for a character, copies of it try several futures."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from poise.env.env import ImitationEnv, Snapshot
from poise.machine import one_thread
from poise.metrics import has_lost

if TYPE_CHECKING:
    from poise.env.generator_goal import Futures, GeneratorGoal
    from poise.env.recovery.recovering import Recovering
    from poise.env.task import Acts

#: m of mean distance from a future within which a copy does it, and at its end, since from farther off
#: it would not go on well.
NEAR_M, END_M = 0.4, 0.3
#: Times that futures are drawn until one is done.
ROUNDS = 8
#: Frames before a copy has lost a future that are left out where no copy does one, and the fewest kept.
SAFE, FEWEST = 15, 10


class TriedFuture(NamedTuple):
    """A future that is to be taken.

    Attributes:
        drawn: how often futures were drawn before. which: of those of the last time. frames: of it that
            are to be taken. done: whether a copy does them.
        path: `(f, 7 + n)`, what the copy does in the first f of them, up to `FutureTrials.sees` before
            the last, from where on it did not know what follows. end: what it is then. Both None where
            it does not do them.
    """

    drawn: int
    which: int
    frames: int
    done: bool
    path: Tensor | None = None
    end: Snapshot | None = None


class FutureTrials:
    """Copies of a character, each of which follows one of several futures by the policy alone.

    Args:
        policy: acts in the copies.
        copies: an environment of as many worlds as futures are tried: without ends and automatic
            restarts (`Imitation.bare`).
        tried: what the copies follow, a generator that makes no frames there.

    Attributes:
        sees: frames ahead of which the policy knows.
    """

    def __init__(self, policy: Acts, copies: ImitationEnv, tried: GeneratorGoal):
        self.policy, self.copies, self.tried = policy, copies, tried
        self._every, self._one = torch.arange(copies.num_envs), torch.zeros(1, dtype=torch.long)
        self.sees = max((1, *copies.task.window))

    def __len__(self) -> int:
        return len(self._every)

    def stand(self, past: Tensor) -> None:
        """Every copy stands where a past `(p, 7 + n)` ends, moving as it does."""
        self.tried.begin_from(self._every, past.expand(len(self), -1, -1))
        self.tried.at[:] = len(past) - 1
        self.copies.backend.write(None, *self.tried.start(None))
        self.copies.age[:], self.copies.action[:] = 0, 0.0

    @one_thread()
    def follow(self, here: Snapshot, frames: Tensor, at: int) -> Snapshot | None:
        """A copy as it is `sees` frames before the end of the frames that its character knows; None if
        it has lost them by then.

        Args:
            here: the character as it is, of an environment with any kind of goal.
            frames: `(k, 7 + n)`, with those before the one that it is at. at: which of them that is.
        """
        tried, copies, every = self.tried, self.copies, self._every
        tried.begin_from(every, frames.expand(len(self), -1, -1))
        tried.at[:] = at
        tried.low[:] = here.worlds["goal/low"]
        own = copies.snapshot(self._one)
        goals = {f"goal/{name}" for name in tried.rows()}
        worlds = {k: (own if k in goals else here).worlds[k] for k in own.worlds}
        obs = copies.restore(Snapshot(worlds, here.physics, own.goal, None))
        for _ in range(len(frames) - 1 - at - self.sees):
            obs = copies.go(self.policy.act(obs))
            if bool(has_lost(copies.here().pos, copies.goal_pose().pos)[0]):
                return None
        return copies.snapshot(self._one)

    def restore(self, snapshot: Snapshot) -> None:
        """Every copy is what a snapshot of one holds."""
        self.copies.restore(snapshot)

    @one_thread()
    def find(
        self,
        futures: Callable[[int], Tensor],
        begin: Callable[[], None],
        by_s: float | None = None,
    ) -> TriedFuture:
        """Tries futures until one is done, and the first of those that were drawn together is taken. If
        none is in `ROUNDS`, the one that is followed for longest is, up to shortly before it is lost.

        Args:
            futures: draws some `(K, f, 7 + n)`, told how often they were drawn before.
            begin: sets the copies and their goals on where the character is.
            by_s: by `time.time`, when no more are drawn that would not be done by then.
        """
        best: TriedFuture | None = None
        begun = time.time()
        for k in range(ROUNDS):
            spent = time.time() - begun
            if best is not None and by_s is not None and begun + spent + spent / k > by_s:
                break
            made = futures(k)
            begin()
            found = self._attempt(made)._replace(drawn=k)
            if found.done:
                return found
            if best is None or found.frames > best.frames:
                best = found
        assert best is not None
        return best._replace(frames=max(FEWEST, best.frames - SAFE))

    def _attempt(self, made: Tensor) -> TriedFuture:
        """The first of the futures `(K, f, 7 + n)` that is done to its end, else the one that is
        followed for longest."""
        copies, tried, every = self.copies, self.tried, self._every
        known = int(tried.count[0] - 1 - tried.at[0])
        tried.extend(every, made[every % len(made)])
        tried.aim(None, None)
        obs = copies.observe()
        # The last frame has no next one yet.
        steps = known + made.shape[1] - 1
        lasts, off = torch.full((len(every),), steps), torch.zeros(len(every))
        paths, ends = list[Tensor](), None
        for k in range(steps):
            obs = copies.go(self.policy.act(obs))
            pos, aim = copies.here().pos, copies.goal_pose().pos
            off = (pos - aim).norm(dim=-1).mean(-1).nan_to_num(torch.inf)
            lost = has_lost(pos, aim) | (off > NEAR_M)
            lasts = torch.where(lost & (lasts == steps), k, lasts)
            if bool((lasts < steps).all()):
                break
            paths.append(copies.backend.state.qpos.clone())
            if k == steps - self.sees:
                ends = copies.snapshot(every)
        steady = (lasts == steps) & (off <= END_M)
        if not bool(steady.any()):
            which = int(lasts.argmax())
            return TriedFuture(0, which % len(made), int(lasts[which]) - known, False)
        which = int(steady.float().argmax())
        found = TriedFuture(0, which % len(made), made.shape[1], True)
        path = paths[known : steps - self.sees + 1]
        if ends is None or not path:
            # Of so few frames nothing was done that does not hang on those that follow.
            return found
        end = ends.picked(self._every[which : which + 1])
        return found._replace(path=torch.stack(path)[:, which], end=end)


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
        trials: copies of the same body and kind of goal.

    Attributes:
        chosen: how often the generator's first future was taken, another one, and one that is lost.
    """

    def __init__(self, acts: Acts, trials: FutureTrials):
        self.acts, self.trials = acts, trials
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

    def _choose(self, world: int, goal: GeneratorGoal) -> bool:
        assert self._env is not None
        trials, snapshot = self.trials, self._env.snapshot(torch.tensor([world]))
        drawn: list[Futures] = []

        def futures(k: int) -> Tensor:
            # The label that the world keeps to counts once.
            drawn.append(goal.futures(world, len(trials), wished=k == 0))
            return drawn[k].made[:, : goal.keeps]

        def begin() -> None:
            trials.copies.restore(snapshot)
            # Frames that a copy's own goal may have made are no part of it.
            trials.tried.count[:], trials.tried.low[:] = goal.count[world], goal.low[world]

        found = trials.find(futures, begin)
        goal.choose(world, drawn[found.drawn], found.which, found.frames)
        self.chosen[2 if not found.done else 0 if found.drawn == found.which == 0 else 1] += 1
        return found.done
