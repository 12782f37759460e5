"""Looking ahead in live motion: beside the loop in a process of its own, or at once, as tests do."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.control import Compliance
from poise.env import ImitationEnv
from poise.env.stream_goal import StreamGoal
from poise.errors import PoiseError
from poise.jobs.track.controllers import look_ahead
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.live.beside import Beside, SnapshotArrays
from poise.plan import Lookahead, LookaheadConfig
from poise.plan.lookahead import PAST, Choice

#: Simulated at once where a character looks ahead in real time: candidates, horizon, hold.
QUICK = LookaheadConfig(candidates=8, horizon=6, hold_steps=3, smoothing=(0.0, 0.7), corrections=(1.0,))


def tries_of(tracker: Tracker, config: LookaheadConfig, seed: int) -> Lookahead:
    """Copies of a live character in which a policy tries what it might do.

    Raises:
        PoiseError: the policy has no critic.
    """
    if tracker.value is None or tracker.recovery_clips is None:
        raise PoiseError(
            "the policy was saved without its critic, which lookahead needs", code="critic-missing"
        )
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    task = replace(task, task=replace(task.task, help_by="all", compliance=Compliance(level=0.0)))
    out = look_ahead(tracker, task, config, 1, seed)
    goal = StreamGoal(task.humanoid, task.config.sim.control_hz, out.copies.num_envs)
    goal.push(tracker.recovery_clips.ease)
    goal.reset(torch.arange(out.copies.num_envs))
    out.copies.set_goal(goal)
    out.copies.record_at_once()
    return out


class AheadAtOnce:
    """Looks ahead while the loop waits, as tests do.

    Attributes:
        acts: whether the last actions had looked ahead.
    """

    def __init__(self, tracker: Tracker, seed: int):
        self._lookahead = tries_of(tracker, QUICK, seed)
        self.acts = False

    def watch(self, env: ImitationEnv, worlds: tuple[int, ...]) -> None:
        """Acts in `env` from now on, and looks ahead in some of its worlds."""
        self._watched = env, worlds
        self._lookahead.watch(env, worlds)

    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)`."""
        self.acts = True
        return self._lookahead.act(obs)

    def skip(self) -> None:
        """The policy acts alone in this step: decisions of before are of another time afterwards."""
        self.watch(*self._watched)

    def close(self) -> None:
        """Frees the copies."""
        self._lookahead.copies.close()


#: Control steps after which a decision that is made beside the loop counts.
LEAD = 3
#: By how much the other process comes after the loop, as `nice` counts.
NICE = 5


class _Asked(NamedTuple):
    """A question to the other process.

    Attributes:
        world: the character's snapshot.
        past, off_m, last, meanwhile: see `Lookahead.decide`.
    """

    world: SnapshotArrays
    past: np.ndarray
    off_m: float
    last: np.ndarray
    meanwhile: np.ndarray


#: Fields of a `Choice`, offsets as an array.
_Answer = tuple[np.ndarray, float, float]


@dataclass(eq=False)
class _LookingCharacter:
    """A character that looks ahead.

    Attributes:
        choice: what it does now, None before the first decision; `step`, control steps since it counts.
        past: `(B, 3)` m, the bodies in the last frames.
        since: control steps since it asked; None where it waits for nothing.
    """

    choice: Choice | None = None
    step: int = 0
    past: list[Tensor] = field(default_factory=list)
    since: int | None = None


class AheadBeside:
    """Looks ahead in a process of its own; characters take turns.

    Attributes:
        acts: whether the last actions had looked ahead; without an answer the policy acts alone.
        decided: decisions that came.
    """

    def __init__(self, tracker: Tracker, seed: int):
        self._policy = tracker.policy
        self._env: ImitationEnv | None = None
        self._worlds = dict[int, _LookingCharacter]()
        self.acts, self.decided = False, 0
        args = replace(tracker, about={}), seed
        self._beside = Beside[_Asked, _Answer](_decider, args, NICE)
        # The question that is open, and its character.
        self._asked: tuple[_LookingCharacter, Future[_Answer]] | None = None

    @property
    def decides(self) -> bool:
        """True while an action is being decided; nothing else is asked meanwhile."""
        return self._asked is not None and not self._asked[1].done()

    def watch(self, env: ImitationEnv, worlds: tuple[int, ...]) -> None:
        """See `AheadAtOnce`. A question of before is not waited for."""
        self._env, self._worlds = env, {k: _LookingCharacter() for k in worlds}

    def act(self, obs: Tensor) -> Tensor:
        """See `AheadAtOnce`."""
        env = self._env
        if env is None:
            raise PoiseError(
                "a lookahead acts in an environment",
                hint="Call watch(env) first",
                code="environment-missing",
            )
        if self._asked is not None and self._asked[1].done() and not self._asked[1].cancelled():
            world, (offsets, *rest) = self._asked[0], self._asked[1].result()
            self._asked = None
            self.decided += 1
            world.choice = Choice(torch.from_numpy(offsets), *rest)
            world.step, world.since = world.since or 0, None
        pos, fresh = env.here().pos, (env.age == 0).tolist()
        n = len(obs)
        offsets = torch.zeros(n, env.num_actions)
        keep, much = torch.zeros(n, 1), torch.ones(n, 1)
        self.acts = False
        for i, world in self._worlds.items():
            if fresh[i]:
                # It was set down anew: what is decided by now is of another place.
                self._worlds[i] = world = _LookingCharacter()
            choice = world.choice
            self._ask(i, world, pos[i])
            if choice is not None and world.step < len(choice.offsets):
                offsets[i] = choice.offsets[world.step]
                keep[i], much[i] = choice.smoothing, choice.correction
                self.acts = True
            world.step += 1
            world.since = None if world.since is None else world.since + 1
            world.past = [*world.past, pos[i].clone()][-PAST:]
        return env.unfiltered(torch.lerp(much * self._policy.act(obs) + offsets, env.action, keep))

    def skip(self) -> None:
        """See `AheadAtOnce`. A question of before is not waited for."""
        self._worlds = {k: _LookingCharacter() for k in self._worlds}

    def _ask(self, i: int, world: _LookingCharacter, pos: Tensor) -> None:
        """Hands a question over, where nothing is being decided and this character's turn has come."""
        env = self._env
        assert env is not None
        if self._asked is not None or (world.choice is not None and world.step < QUICK.hold_steps):
            return
        if len(self._worlds) > 1 and world is not max(self._worlds.values(), key=lambda w: w.step):
            return
        ahead = torch.zeros(LEAD, env.num_actions)
        last = ahead[:0]
        if world.choice is not None:
            planned = world.choice.offsets[world.step : world.step + LEAD]
            ahead[: len(planned)] = planned
            last = world.choice.offsets[world.step + LEAD :][: QUICK.horizon]
        snapshot = env.snapshot(torch.tensor([i]))
        past = torch.stack(world.past) if world.past else pos[None][:0]
        off = float((pos - env.goal_pose().pos[i]).norm(dim=-1).mean())
        arrays = past.numpy(), off, last.numpy(), ahead.numpy()
        world.since = 0
        self._asked = world, self._beside.ask(_Asked(SnapshotArrays.of(snapshot), *arrays))

    def close(self) -> None:
        """See `AheadAtOnce`."""
        self._beside.close()


def _decider(tracker: Tracker, seed: int) -> Callable[[_Asked], _Answer]:
    """Decides in the other process."""
    lookahead = tries_of(tracker, QUICK, seed)

    def decide(asked: _Asked) -> _Answer:
        last, meanwhile, past = (torch.from_numpy(x) for x in (asked.last, asked.meanwhile, asked.past))
        made = lookahead.decide(asked.world.snapshot(), past, asked.off_m, last, meanwhile)
        return made.offsets.numpy(), made.smoothing, made.correction

    return decide
