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

    hindsight: what is asked for now, by which rewards and ends are judged, stays where it is; what comes
    next, which policies see and actions add to, is displaced (`Stiffness.hindsight`).
    """

    def __init__(self, goal: Goal, hindsight: bool = False):
        self.goal, self._hindsight = goal, hindsight
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
        now = self.goal.now(ids)
        return now if self._hindsight else self._moved(now, ids)

    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        return self._moved(self.goal.ahead(k, ids), ids)

    def window(self, steps: tuple[int, ...], ids: Tensor | None = None) -> Tensor:
        return self._moved_all(self.goal.window(steps, ids), ids)

    def targets(self) -> tuple[Tensor, Tensor]:
        table, rows = self.goal.targets()
        return table[rows] + self.offset[:, 6:], self._every

    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        now, ahead = self.goal.advance(waited, held)
        if self._hindsight:
            return now, self._moved(ahead, None)
        now, ahead = self._moved_all(torch.stack((now, ahead), 1), None).unbind(1)
        return now, ahead

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
        """Packed poses `(n, W)` by the offsets of worlds `ids`; those without any stay as they are."""
        return self._moved_all(packed.unsqueeze(1), ids).squeeze(1)

    def _moved_all(self, packed: Tensor, ids: Tensor | None) -> Tensor:
        """The same of K poses of each world `(n, K, W)`."""
        offset, rate = (x if ids is None else x[ids] for x in (self.offset, self.rate))
        off = ((offset != 0) | (rate != 0)).any(-1)
        if not bool(off.any()):
            return packed
        whole, k = bool(off.all()), packed.shape[1]
        moved, offset, rate = (x if whole else x[off] for x in (packed, offset, rate))
        rows = moved.flatten(0, 1)
        pose, place = self.layout.unpacked(rows), rows[:, -len(self.layout.place(rows)) :]
        many = (x.repeat_interleave(k, 0) for x in (offset, rate))
        qpos = displaced(pose.qpos.double(), next(many)).cpu()
        qvel = (pose.qvel.double() + next(many)).cpu()
        made = self.layout.pack(self._poser.live(qpos, qvel), place.cpu()).to(packed).view_as(moved)
        if whole:
            return made
        out = packed.clone()
        out[off] = made
        return out
