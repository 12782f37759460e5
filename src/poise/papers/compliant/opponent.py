"""Another character in the same worlds that acts by a policy of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.env.env import ImitationEnv
from poise.env.goals.goal import Goal
from poise.env.plugins import Plugin
from poise.env.task import Acts
from poise.errors import PoiseError
from poise.sim import Backend, CharacterRows, Drive


@dataclass(frozen=True, eq=False)
class Opponent:
    """Given to `TaskConfig.plugins`: a character of the scene that another environment drives, step by
    step with the one that holds the plug-in.

    Unlike `Teams` it lets one environment be looked at as any other; the other's episodes begin where
    its clip does, with those of all worlds, and never end.

    Attributes:
        name: of the character in the scene.
        make: the environment on its rows, without automatic reset.
        policy: acts for it.
    """

    name: str
    make: Callable[[Backend], ImitationEnv]
    policy: Acts

    def __call__(self, goal: Goal, backend: Backend) -> Opposing:
        """The plug-in of an environment."""
        if not isinstance(backend, CharacterRows) or backend.sim is None or len(backend.places) != 1:
            what = "an opponent needs a scene with one character and itself in each world"
            raise PoiseError(what, f"Opponent '{self.name}'")
        return Opposing(self, backend.sim.characters(self.name))


class Opposing(Plugin):
    """`Opponent` in N worlds.

    Attributes:
        env: its environment.
    """

    def __init__(self, given: Opponent, rows: CharacterRows):
        self._policy, self._rows, self.env = given.policy, rows, given.make(rows)
        self._zero = torch.zeros(rows.num_envs, dtype=torch.long, device=rows.device)
        self._obs = self.env.reset_to(self._zero, self._zero)
        self._held: tuple[Tensor, ...] | None = None

    def placed(self, ids: Tensor | None) -> None:
        """It begins anew where all worlds do."""
        if ids is None or len(ids) == len(self._zero):
            self._obs = self.env.reset_to(self._zero, self._zero)

    def push(self, drive: Drive) -> None:
        """Its action for the control step that begins."""
        actuation = self.env.controls.actuation
        self.env.drive(self._policy.act(self._obs))
        actuation.push()
        self._held, self._first = actuation.held(), True
        self._rows.push()

    def busy(self) -> bool:
        return any(p.busy() for p in self.env.controls.actuation.pushing_substeps)

    def push_substep(self, drive: Drive) -> None:
        if not self._first:
            self._rows.pull()
        self.env.controls.actuation.push_substep(None if self._first else self._held)
        self._first = False
        self._rows.push()

    def tick(self) -> None:
        self._rows.pull()
        self._obs = self.env.renew(self.env.judge()).obs
