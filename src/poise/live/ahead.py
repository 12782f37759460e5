"""Looking ahead in live motion: what acts in place of the policy, and doing it at once, as tests do."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from poise.control import Compliance
from poise.env import ImitationEnv
from poise.env.goals import StreamGoal
from poise.errors import PoiseError
from poise.jobs.track.controllers import look_ahead
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.plan import Lookahead, LookaheadConfig

#: Simulated at once where a character looks ahead in real time: candidates, horizon, hold.
QUICK = LookaheadConfig(candidates=8, horizon=6, hold_steps=3, smoothing=(0.0, 0.7), corrections=(1.0,))


class Ahead(Protocol):
    """What acts in place of the policy in the worlds that look ahead."""

    def watch(self, env: ImitationEnv, worlds: tuple[int, ...]) -> None:
        """Acts in `env` from now on, and looks ahead in some of its worlds."""
        ...

    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)`."""
        ...

    def skip(self) -> None:
        """The policy acts alone in this step: what was decided before is of another time afterwards."""
        ...

    @property
    def acts(self) -> bool:
        """Whether the last actions had looked ahead."""
        ...

    def close(self) -> None:
        """Frees what it holds."""
        ...


def tries_of(tracker: Tracker, config: LookaheadConfig, seed: int) -> Lookahead:
    """Copies of a live character in which a policy tries what it might do.

    Raises:
        PoiseError: the policy has no critic.
    """
    if tracker.value is None or tracker.recovery_clips is None:
        raise PoiseError("the policy was saved without its critic, which lookahead needs")
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    task = replace(task, task=replace(task.task, help_by="all", compliance=Compliance(level=0.0)))
    out = look_ahead(tracker, task, config, 1, seed)
    goal = StreamGoal(task.humanoid, task.config.sim.control_hz, out.copies.num_envs)
    goal.push(tracker.recovery_clips.ease)
    goal.draw(torch.arange(out.copies.num_envs))
    out.copies.set_goal(goal)
    return out


class AheadAtOnce:
    """Looks ahead while the loop waits, as tests do."""

    def __init__(self, tracker: Tracker, seed: int):
        self._lookahead = tries_of(tracker, QUICK, seed)
        self.acts = False

    def watch(self, env: ImitationEnv, worlds: tuple[int, ...]) -> None:
        """See `Ahead`."""
        self._watched = env, worlds
        self._lookahead.watch(env, worlds)

    def act(self, obs: Tensor) -> Tensor:
        """See `Ahead`."""
        self.acts = True
        return self._lookahead.act(obs)

    def skip(self) -> None:
        """See `Ahead`."""
        self.watch(*self._watched)

    def close(self) -> None:
        """See `Ahead`."""
        self._lookahead.copies.close()
