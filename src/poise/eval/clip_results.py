"""Which clips a policy does to their end from the first frame, and how closely.

PHC's evaluation: a clip fails where the mean distance of the bodies exceeds 0.5 m in any frame. Nothing
is recorded, and no frame after a failure is simulated for its own sake, so that a library of thousands
of clips is evaluated while it is learned.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.metrics import has_lost, mpjpe_global, mpjpe_root

#: Control steps between looks at whether anything is left to see, which a GPU must be waited for.
LOOK = 16


@dataclass(frozen=True, eq=False)
class ClipResults:
    """What E clips came to, from frame 0 or from several; one row per clip.

    clip: its index. succeeded: bool. frames: its frames. tracked: those before it failed, or all.
    mpjpe_mm, global_mm: means over the frames up to the one that failed, with the root's error and
    without.
    """

    clip: Tensor
    succeeded: Tensor
    frames: Tensor
    tracked: Tensor
    mpjpe_mm: Tensor
    global_mm: Tensor

    @property
    def rate(self) -> float:
        """Share of the clips that succeeded."""
        return float(self.succeeded.double().mean())

    @property
    def tracked_share(self) -> float:
        """Share of the frames of all clips before they failed."""
        return float(self.tracked.sum() / self.frames.sum())

    @property
    def error_mm(self) -> float:
        """Global error over the frames of all clips, mm."""
        seen = (self.tracked + (~self.succeeded).long()).double()
        return float((self.global_mm * seen).sum() / seen.sum())

    def spread(self, values: Tensor, clips: int) -> Tensor:
        """`values (E,)` in a row of all `clips`; 0 for those that were not evaluated."""
        out = values.new_zeros(clips)
        out[self.clip] = values
        return out

    def hardest(self, count: int) -> list[int]:
        """Clips that failed, those first of which the least was tracked."""
        share = (self.tracked / self.frames)[~self.succeeded]
        return self.clip[~self.succeeded][share.argsort(stable=True)][:count].tolist()


class ClipJudge:
    """Observes clips from their first frames and keeps of each what it came to.

    last: `(E,)` the last frame of each world's clip.
    """

    def __init__(self, last: Tensor):
        self.last = last
        self.alive, self.tracked = torch.ones_like(last, dtype=torch.bool), torch.ones_like(last)
        # The first frame is the clip's own.
        self.local, self.far = (torch.zeros_like(last, dtype=torch.float64) for _ in range(2))
        self.count = torch.ones_like(self.local)

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Adds one frame of each clip that has not ended or failed."""
        if step == 0:
            return False
        sim, ref = env.pose().pos, env.goal_pose().pos
        distance, counted = mpjpe_global(sim, ref), self.alive & (step <= self.last)
        # A world that went bad has no distance, and has failed.
        good = ~has_lost(sim, ref) & distance.isfinite()
        known = counted & distance.isfinite()
        self.far += torch.where(known, distance, 0.0)
        self.local += torch.where(known, mpjpe_root(sim, ref), 0.0)
        self.count += known
        self.alive &= good | ~counted
        self.tracked += counted & good
        return step % LOOK == 0 and not bool((self.alive & (step < self.last)).any())

    def results(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Success, frames tracked, mean errors without and with the root's; `(E,)` on the CPU."""
        found = self.alive, self.tracked, self.local / self.count, self.far / self.count
        return found[0].cpu(), found[1].cpu(), found[2].cpu(), found[3].cpu()
