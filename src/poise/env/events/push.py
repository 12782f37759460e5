"""One push at a stated time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.env.goals.goal import Goal
from poise.env.plugins import Felt, Plugin, Start
from poise.errors import PoiseError
from poise.sim import Backend, Drive


@dataclass(frozen=True)
class Push:
    """A constant force on one body for some time of each episode; given to `TaskConfig.plugins`.

    Attributes:
        row: of the body table; the force acts at the body's inertial centre.
        force: N, world axes.
        first: the control step of the episode in which it begins.
        steps: control steps that it lasts.
        foreseen: whether it begins and ends in this environment by itself. Copies in which a controller
            looks ahead take False: they feel what acts where they were copied, as long as they last,
            and know of no push to come.
    """

    row: int
    force: tuple[float, float, float]
    first: int
    steps: int
    foreseen: bool = True

    def __post_init__(self) -> None:
        if self.row < 0 or self.first < 0 or self.steps < 1:
            raise PoiseError("row and first must be at least 0, steps at least 1", "Push")
        if not all(math.isfinite(f) for f in self.force):
            raise PoiseError(f"the force is not finite: {self.force}", "Push")

    def __call__(self, goal: Goal, backend: Backend) -> OnePush:
        """The plug-in of an environment."""
        bodies = len(goal.humanoid.bodies)
        if self.row >= bodies:
            raise PoiseError(f"the body has {bodies} parts, there is no row {self.row}", "Push")
        return OnePush(self, backend)


class OnePush(Plugin):
    """The push on the characters of a backend.

    Attributes:
        step: `(N,)` control steps of each episode that were made.
        acts: `(N,)` bool, characters that are pushed in the next control step.
    """

    def __init__(self, push: Push, backend: Backend):
        self.given, self._backend = push, backend
        n, here = backend.num_envs, backend.device
        self.step = torch.zeros(n, dtype=torch.long, device=here)
        self.acts = torch.zeros(n, dtype=torch.bool, device=here)
        self._force = torch.tensor(push.force).to(backend.drive.xfrc_applied)
        self._know()

    def start(
        self, ids: Tensor | None, kind: Tensor | None, start: Start, rng: torch.Generator
    ) -> Start:
        """Episodes begin before the push."""
        self.step[slice(None) if ids is None else ids] = 0
        self._know()
        return start

    def push(self, drive: Drive) -> None:
        """Adds the force."""
        drive.xfrc_applied[self.acts, self.given.row + 1, :3] += self._force

    def felt(self) -> Felt:
        """The push, where it acts."""
        n, body = len(self.acts), self.given.row + 1
        rows = torch.full((n, 1), body, dtype=torch.long, device=self.acts.device)
        force = self._force * self.acts.unsqueeze(1)
        return Felt(rows, self._backend.state.xipos[:, body : body + 1], force.unsqueeze(1))

    def tick(self) -> None:
        """Counts on."""
        self.step += 1
        self._know()

    def rows(self) -> dict[str, Tensor]:
        return {"one push/step": self.step, "one push/acts": self.acts}

    def state(self) -> dict[str, Tensor]:
        """Where the episodes are."""
        return {k: v.clone() for k, v in self.rows().items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from there; from a task without this push from the begin of its time."""
        for name, value in self.rows().items():
            if name in state:
                value.copy_(state[name])

    def _know(self) -> None:
        if self.given.foreseen:
            first = self.given.first
            self.acts.copy_((self.step >= first) & (self.step < first + self.given.steps))
