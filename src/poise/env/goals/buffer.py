"""The frames of N motions that become known as they go, as packed poses."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.goals.goal import extrapolated
from poise.env.plugins import Start
from poise.env.poser import Poser
from poise.sim import difference


class FrameBuffer:
    """The last L frames of N motions.

    Frames are counted from 0 on; `count (N,)` says how many are known. Frames before the last L are
    forgotten and read as the oldest that is kept; frames beyond the last are extrapolated.

    Velocities are differences to the frame before, so that none waits for a frame to come: a stream's
    last frame has one, too. The first frame stands still.
    """

    def __init__(
        self, humanoid: Humanoid, rate_hz: float, num_envs: int, size: int, device: torch.device
    ):
        self.humanoid, self.rate_hz, self.size = humanoid, rate_hz, size
        self.poser, self.device = Poser(humanoid), device
        self.layout = self.poser.layout()
        nq, nv = humanoid.model.nq, humanoid.model.nv
        self.qpos = torch.zeros(num_envs, size, nq, dtype=torch.float64, device=device)
        self.qpos[..., 3] = 1.0
        self.qvel = torch.zeros(num_envs, size, nv, dtype=torch.float64, device=device)
        self.count = torch.zeros(num_envs, dtype=torch.long, device=device)
        #: `(N,)` the lowest root height so far, m.
        self.low = torch.full((num_envs,), torch.inf, dtype=torch.float64, device=device)
        #: `(N,)` index of the last frame of all, where that is known; else far away.
        self.last = torch.full_like(self.count, 2**62)

    def clear(self, ids: Tensor) -> None:
        """Worlds `ids (n,)` know no frame."""
        self.count[ids], self.last[ids], self.low[ids] = 0, 2**62, torch.inf

    def append(self, ids: Tensor, qpos: Tensor, still: Tensor | None = None) -> None:
        """One more frame `qpos (n, 7 + n)` in worlds `ids (n,)`.

        still: `(n,)` bool, frames that have no velocity, such as those after a jump.
        """
        at = self.count[ids]
        before = self.qpos[ids, (at - 1) % self.size]
        qvel = difference(qpos, before) * self.rate_hz
        none = at == 0 if still is None else (at == 0) | still
        self.qvel[ids, at % self.size] = torch.where(none.unsqueeze(-1), 0.0, qvel)
        self.qpos[ids, at % self.size] = qpos
        self.low[ids] = torch.minimum(self.low[ids], qpos[:, 2])
        self.count[ids] += 1

    def coordinates(self, ids: Tensor, index: Tensor) -> Start:
        """qpos `(n, 7 + n)` and qvel `(n, 6 + n)` of frames `index (n,)` of worlds `ids (n,)`."""
        known = self.count[ids]
        kept = torch.minimum(index, self.last[ids])
        at = torch.minimum(kept, known - 1).clamp_min(0)
        at = torch.maximum(at, known - self.size).clamp_min(0)
        qpos, qvel = self.qpos[ids, at % self.size], self.qvel[ids, at % self.size]
        beyond = (kept - at).clamp_min(0) * (kept >= known)
        if not bool((beyond > 0).any()):
            return qpos, qvel
        return extrapolated(qpos, qvel, beyond, self.rate_hz)

    def packed(self, ids: Tensor, index: Tensor) -> Tensor:
        """Packed poses `(n, W)` of frames `index (n,)`; the place says where the motion ends."""
        qpos, qvel = (x.cpu() for x in self.coordinates(ids, index))
        pose = self.poser.live(qpos, qvel)
        end = (index >= self.last[ids]).float().cpu()
        low = torch.where(self.low[ids].isfinite(), self.low[ids], 0.0).float().cpu()
        place = torch.stack((torch.zeros_like(end), low, end, torch.zeros_like(end)), 1)
        return self.layout.pack(pose, place).to(self.device)

    def rows(self) -> dict[str, Tensor]:
        """Its tensors, a row per world."""
        names = ("qpos", "qvel", "count", "last", "low")
        return {name: getattr(self, name) for name in names}
