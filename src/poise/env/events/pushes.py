"""Pushes at random times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.env.goals.goal import Goal
from poise.env.plugins import Felt, Plugin, Start
from poise.errors import PoiseError
from poise.sim import Backend, Drive


@dataclass(frozen=True)
class Pushes:
    """Pushes on random bodies at random times, each of a random horizontal direction; given to
    `TaskConfig.plugins`.

    Attributes:
        newtons: between which the force is drawn, N.
        every_s: between which the time from one push's end to the next one's begin is drawn, s.
        lasts_s: how long each lasts, s.
        bodies: rows of the body table of which one is pushed at its inertial centre.
        control_hz: control steps per second.
        seed: of the draws.
    """

    newtons: tuple[float, float] = (50.0, 200.0)
    every_s: tuple[float, float] = (1.0, 3.0)
    lasts_s: float = 0.2
    bodies: tuple[int, ...] = (0,)
    control_hz: float = 30.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("newtons", "every_s"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high < float("inf"):
                raise PoiseError(f"{name} must rise from at least 0, got {low:g} to {high:g}", "Pushes")
        if not (self.lasts_s > 0.0 and self.control_hz > 0.0):
            raise PoiseError("lasts_s and control_hz must be above 0", "Pushes")
        if not self.bodies:
            raise PoiseError("pushes need at least one body", "Pushes")

    def __call__(self, goal: Goal, backend: Backend) -> Pushing:
        """The plug-in of an environment."""
        return Pushing(self, backend)


class Pushing(Plugin):
    """The pushes on the characters of a backend.

    Attributes:
        left: `(N,)` control steps until a push begins; from 0 down those that it has lasted.
        force: `(N, 3)` N of the next or present push, world axes.
        body: `(N,)` MuJoCo's body that it is on.
    """

    def __init__(self, pushes: Pushes, backend: Backend):
        self.pushes, n, here = pushes, backend.num_envs, backend.device
        self._backend = backend
        self._rng = torch.Generator().manual_seed(pushes.seed)
        self._lasts = max(1, round(pushes.lasts_s * pushes.control_hz))
        self.left = torch.zeros(n, dtype=torch.long, device=here)
        self.body = torch.zeros(n, dtype=torch.long, device=here)
        self.force = torch.zeros(n, 3, dtype=backend.drive.xfrc_applied.dtype, device=here)
        self._draw(torch.arange(n, device=here))

    @property
    def acting(self) -> Tensor:
        """`(N,)` bool, characters that are pushed in this control step."""
        return self.left <= 0

    def start(
        self, ids: Tensor | None, kind: Tensor | None, start: Start, rng: torch.Generator
    ) -> Start:
        """Episodes begin with a time without a push."""
        self._draw(torch.arange(len(self.left), device=self.left.device) if ids is None else ids)
        return start

    def push(self, drive: Drive) -> None:
        """Adds the force of each push."""
        rows = self.acting.nonzero().squeeze(-1)
        drive.xfrc_applied[rows, self.body[rows], :3] += self.force[rows]

    def felt(self) -> Felt:
        """The pushes that act."""
        force = self.force * self.acting.unsqueeze(1)
        point = self._backend.state.xipos.gather(1, self.body.view(-1, 1, 1).expand(-1, 1, 3))
        return Felt(self.body.unsqueeze(1), point, force.unsqueeze(1))

    def tick(self) -> None:
        """Counts down, and draws the next push where one is over."""
        self.left -= 1
        self._draw((self.left <= -self._lasts).nonzero().squeeze(-1))

    def rows(self) -> dict[str, Tensor]:
        return {"push/left": self.left, "push/body": self.body, "push/force": self.force}

    def state(self) -> dict[str, Tensor]:
        """The pushes, and the generator of those to come."""
        rows = {k: v.clone() for k, v in self.rows().items()}
        return {**rows, "push/rng": self._rng.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on with the same pushes; from a task without pushes with those it has."""
        if "push/rng" in state:
            for name, value in self.rows().items():
                value.copy_(state[name])
            self._rng.set_state(state["push/rng"])

    def _draw(self, ids: Tensor) -> None:
        p, n = self.pushes, len(ids)
        unit = torch.rand(3, n, generator=self._rng)
        pick = torch.randint(len(p.bodies), (n,), generator=self._rng)
        wait = p.every_s[0] + (p.every_s[1] - p.every_s[0]) * unit[0]
        size = p.newtons[0] + (p.newtons[1] - p.newtons[0]) * unit[1]
        angle = 2 * torch.pi * unit[2]
        force = torch.stack((size * angle.cos(), size * angle.sin(), 0 * size), 1)
        self.left[ids] = (wait * p.control_hz).round().long().clamp_min(1).to(self.left.device)
        self.force[ids] = force.to(self.force)
        self.body[ids] = (torch.tensor(p.bodies)[pick] + 1).to(self.body.device)
