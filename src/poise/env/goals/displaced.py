"""A goal that is displaced: what yields to forces moves it (Deep Compliant Control)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from poise.env.bins import Outcomes
from poise.env.goals.clip import ClipGoal
from poise.env.goals.goal import Goal, Group
from poise.env.plugins import Start
from poise.env.poser import Poser
from poise.sim import displaced


class DisplacedGoal(Goal):
    """Another goal, moved by `offset (N, 6 + n)`: m and rad of the root, rad of the hinges, in the
    coordinates of velocities (`sim.displaced`). Whatever yields to forces writes the offset, and `rate`
    `(N, 6 + n)`, its velocity, which is added to the goal's.
    """

    def __init__(self, goal: Goal):
        self.goal = goal
        self.humanoid, self.bodies, self.rate_hz = goal.humanoid, goal.bodies, goal.rate_hz
        self.layout, self.num_envs, self.device = goal.layout, goal.num_envs, goal.device
        self.rng, self.notes, self.begins = goal.rng, goal.notes, goal.begins
        nv = self.humanoid.model.nv
        self.offset = torch.zeros(self.num_envs, nv, dtype=torch.float64, device=self.device)
        self.rate = torch.zeros_like(self.offset)
        self._poser = Poser(self.humanoid)
        self._every = torch.arange(self.num_envs, device=self.device)

    def local(self, qpos: Tensor) -> Tensor:
        return self.goal.local(qpos)

    @property
    def clips(self) -> ClipGoal:
        return self.goal.clips

    def draw(self, ids: Tensor) -> None:
        self.goal.draw(ids)
        self.offset[ids], self.rate[ids] = 0.0, 0.0

    def seek(self, clip: Tensor, frame: Tensor) -> None:
        self.goal.seek(clip, frame)
        self.offset.zero_()
        self.rate.zero_()

    def start(self, ids: Tensor | None) -> Start:
        qpos, qvel = self.goal.start(ids)
        rows = self._every if ids is None else ids
        return displaced(qpos, self.offset[rows]), qvel + self.rate[rows]

    def aim(self, ids: Tensor | None, held: Tensor | None) -> None:
        self.goal.aim(ids, held)

    def body(self, ids: Tensor | None) -> Tensor:
        return self.goal.body(ids)

    def now(self, ids: Tensor | None = None) -> Tensor:
        return self._moved(self.goal.now(ids), ids)

    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        return self._moved(self.goal.ahead(k, ids), ids)

    def window(self, steps: tuple[int, ...], ids: Tensor | None = None) -> Tensor:
        return torch.stack([self._moved(w, ids) for w in self.goal.window(steps, ids).unbind(1)], 1)

    def targets(self) -> tuple[Tensor, Tensor]:
        table, rows = self.goal.targets()
        return table[rows] + self.offset[:, 6:], self._every

    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        now, ahead = self.goal.advance(waited, held)
        return self._moved(now, None), self._moved(ahead, None)

    def watch(self, qpos: Tensor, pos: Tensor, linvel: Tensor) -> bool:
        return self.goal.watch(qpos, pos, linvel)

    def groups(self, by: Group) -> int:
        return self.goal.groups(by)

    def group(self, by: Group) -> Tensor:
        return self.goal.group(by)

    def row(self) -> Tensor:
        return self.goal.row()

    def outcomes(self, row: Tensor, age: Tensor, failed: Tensor, done: Tensor) -> Outcomes:
        return self.goal.outcomes(row, age, failed, done)

    def where(self, env: int) -> str:
        return self.goal.where(env)

    def state(self) -> dict[str, Tensor]:
        own = {"goal/offset": self.offset.clone(), "goal/offset_rate": self.rate.clone()}
        return {**self.goal.state(), **own}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.goal.load_state(state)
        self.offset.copy_(state["goal/offset"])
        self.rate.copy_(state["goal/offset_rate"])

    def rows(self) -> dict[str, Tensor]:
        return {**self.goal.rows(), "offset": self.offset, "offset_rate": self.rate}

    def _moved(self, packed: Tensor, ids: Tensor | None) -> Tensor:
        """Packed poses by the offsets of worlds `ids`; those that have none stay as they are."""
        offset, rate = (x if ids is None else x[ids] for x in (self.offset, self.rate))
        off = ((offset != 0) | (rate != 0)).any(-1).nonzero().squeeze(-1)
        if not len(off):
            return packed
        pose = self.layout.unpacked(packed[off])
        qpos = displaced(pose.qpos.double(), offset[off]).cpu()
        qvel = (pose.qvel.double() + rate[off]).cpu()
        place = packed[off][:, -len(self.layout.place(packed)) :]
        out = packed.clone()
        out[off] = self.layout.pack(self._poser.live(qpos, qvel), place.cpu()).to(packed)
        return out
