"""Goals of which only some frames are known: what streams and generators share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.goals.buffer import FrameBuffer
from poise.env.goals.goal import Goal
from poise.env.plugins import Start
from poise.env.poser import Poser


class BufferedGoal(Goal):
    """Frames come into a `FrameBuffer`, and every world reads along it.

    Attributes:
        at: `(N,)` the frame that each world is at.
        buffer: what is known.
    """

    def __init__(
        self,
        humanoid: Humanoid,
        rate_hz: float,
        num_envs: int,
        size: int,
        device: torch.device,
        seed: int,
    ):
        self.humanoid, self.bodies, self.rate_hz = humanoid, (humanoid,), rate_hz
        self.num_envs, self.device, self.notes = num_envs, device, []
        self.rng = torch.Generator().manual_seed(seed)
        self.buffer = FrameBuffer(humanoid, rate_hz, num_envs, size, device)
        self.layout, self._poser = self.buffer.layout, Poser(humanoid, device)
        self.at = torch.zeros(num_envs, dtype=torch.long, device=device)
        self._every = torch.arange(num_envs, device=device)
        self._wait = torch.zeros_like(self.at)
        self._ahead = self.buffer.packed(self._every, self.at)
        self._hinges = self.buffer.qpos[:, 0, 7:].clone()
        # Worlds with a next frame that may have changed since it was looked up.
        self._stale = torch.zeros(num_envs, dtype=torch.bool, device=device)

    def local(self, qpos: Tensor) -> Tensor:
        return self._poser.local(qpos)

    @abstractmethod
    def supply(self, ids: Tensor) -> None:
        """Frames for worlds `ids (n,)` that are about to be read, as far as there are any."""

    def start(self, ids: Tensor | None) -> Start:
        ids = self._every if ids is None else ids
        return self.buffer.coordinates(ids, self.at[ids])

    def aim(self, ids: Tensor | None, held: Tensor | None) -> None:
        ids = self._every if ids is None else ids
        self._wait = torch.zeros_like(self.at) if held is None else held.long()
        self.supply(ids)
        self._stale[ids] = True

    def _look(self) -> None:
        """Looks up the next frames where they may have changed."""
        ids = self._stale.nonzero().squeeze(-1)
        if not len(ids):
            return
        index = self.at[ids] + 1 - self._wait[ids]
        self._ahead = self._ahead.clone()
        self._ahead[ids] = self.buffer.packed(ids, index)
        self._hinges[ids] = self.buffer.coordinates(ids, index)[0][:, 7:]
        self._stale[ids] = False

    def now(self, ids: Tensor | None = None) -> Tensor:
        ids = self._every if ids is None else ids
        return self.buffer.packed(ids, self.at[ids])

    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        if k == 1:
            self._look()
            return self._ahead if ids is None else self._ahead[ids]
        ids = self._every if ids is None else ids
        return self.buffer.packed(ids, self.at[ids] + k)

    def targets(self) -> tuple[Tensor, Tensor]:
        self._look()
        return self._hinges, self._every

    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        now = self.ahead()
        self.at += 1 if waited is None else 1 - waited.long()
        self.aim(None, held)
        return now, self.ahead()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        super().load_state(state)
        self._stale[:] = True

    def rows(self) -> dict[str, Tensor]:
        return {"at": self.at, **self.buffer.rows()}
