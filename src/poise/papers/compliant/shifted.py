"""Characters without what displaces their goals, q (-) u, and where they were."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from poise.env.frame import Frame, Observable
from poise.env.goals.displaced import DisplacedGoal
from poise.env.goals.goal import Goal
from poise.env.plugins import Plugin, Start
from poise.kin import Kinematics
from poise.sim import Backend, Drive, displaced
from poise.spatial import heading_quat, lateral_heading


class Undisplaced(NamedTuple):
    """q (-) u of N characters (Sec. 4.2): what they would be if they did not give way.

    pos `(N, B, 3)` m and quat `(N, B, 4)` of all bodies in the world, local `(N, J, 4)` turns of hinged
    bodies, heading `(N, 4)`; before `(N, B, 3)` m, pos one control step earlier.
    """

    pos: Tensor
    quat: Tensor
    local: Tensor
    heading: Tensor
    before: Tensor


class Shifted(Plugin):
    """Gives terms `frame.shifted`, see `Undisplaced`; given to `TaskConfig.plugins`.

    The displacement is taken back in the coordinates in which it was added (`sim.displaced`): hinge by
    hinge, where the logarithm of a joint's turn is the difference of its angles, and of the root.

    Attributes:
        before: `(N, B, 3)` m, where the bodies were when the last control step began; in a new episode
            where their velocities say.
    """

    def __init__(self, goal: Goal, backend: Backend):
        table, n, here = goal.humanoid.table, backend.num_envs, backend.device
        self._backend, self._rate = backend, goal.rate_hz
        self._kinematics = Kinematics(table, torch.float32, here)
        nothing = torch.zeros(n, goal.humanoid.model.nv, dtype=torch.float64, device=here)
        self._u = goal.offset if isinstance(goal, DisplacedGoal) else nothing
        self.before = torch.zeros(n, len(table.rows), 3, device=here)

    @property
    def observables(self) -> Mapping[str, Observable]:
        return {"shifted": self._shifted}

    def sources(self) -> Mapping[str, Tensor]:
        return {"shifted/u": self._u, "shifted/before": self.before}

    def start(
        self, ids: Tensor | None, kind: Tensor | None, start: Start, rng: torch.Generator
    ) -> Start:
        body = self._kinematics(*(x.float() for x in start))
        rows = slice(None) if ids is None else ids
        self.before[rows] = body.pos - body.linvel / self._rate
        return start

    def push(self, drive: Drive) -> None:
        """A control step begins."""
        state = self._backend.state
        if not bool(self._u.any()):
            self.before.copy_(state.xpos[:, 1:])
            return
        self.before.copy_(self._kinematics(displaced(state.qpos.double(), -self._u).float()).pos)

    def rows(self) -> dict[str, Tensor]:
        return {"shifted/before": self.before}

    def state(self) -> dict[str, Tensor]:
        return {"shifted/before": self.before.clone()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from where the bodies were; from a task that did not know with what is known here."""
        if "shifted/before" in state:
            self.before.copy_(state["shifted/before"])

    def _shifted(self, frame: Frame) -> Undisplaced:
        qpos = displaced(frame.source("qpos").double(), -frame.source("shifted/u")).float()
        body, root, left = self._kinematics(qpos), qpos[:, 3:7], frame.context.left
        heading = heading_quat(root) if left is None else lateral_heading(root, left)
        local = frame.context.local(qpos)
        return Undisplaced(body.pos, body.quat, local, heading, frame.source("shifted/before"))
