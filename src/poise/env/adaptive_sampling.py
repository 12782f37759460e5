"""Adaptive sampling: motion bins in which episodes fail are begun in more often."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from poise.env.bins import Outcomes
from poise.env.plugins import Ended, Plugin

#: Control steps of all worlds after which failures are counted up, and what is then left of older ones.
EVERY, KEPT = 64, 0.9
#: Outcomes without a failure that every bin is taken to have had.
PRIOR = 5.0
#: With which odds a bin is practised that always fails; one that fails half of the time has 0.3.
ALWAYS_FAILS = 0.1


class AdaptiveSampling(Plugin):
    """How often episodes failed in each of G motion bins lately: those in which they fail are begun in
    more often.

    Attributes:
        odds: `(G,)` float64 on the CPU, with which bins are to be practised: f (1 + `ALWAYS_FAILS` - f)
            of the share f that failed, most where about every second episode fails. Bins that always
            fail are neither dwelled on nor given up.
    """

    def __init__(self, bins: int, device: torch.device | str = "cpu"):
        self._counts = torch.zeros(2, bins, dtype=torch.float64, device=device)
        self.steps = 0
        self._rate()

    def count(self, ended: Ended) -> None:
        self.add(ended.bins)

    def add(self, seen: Outcomes) -> None:
        """One control step of all worlds."""
        # Zeros and ones are added, so that their order, which a GPU does not keep, makes no difference.
        self._counts.index_add_(1, seen.bin, torch.stack((seen.ended, seen.failed)))
        self.steps += 1
        if self.steps % EVERY == 0:
            self._rate()
            self._counts *= KEPT

    def _rate(self) -> None:
        ended, failed = self._counts.cpu()
        share = failed / (ended + PRIOR)
        self.odds = share * (1.0 + ALWAYS_FAILS - share)

    def state(self) -> dict[str, Tensor]:
        """Under "hardness", float64 `(1 + 3 G)`."""
        steps = torch.tensor([self.steps]).double()
        return {"hardness": torch.cat((steps, self.odds, self._counts.cpu().flatten()))}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from `state()`; from that of other bins as if nothing were known."""
        bins, saved = self._counts.shape[1], state.get("hardness")
        if saved is None or len(saved) != 1 + 3 * bins:
            return
        self.steps, own = int(saved[0]), saved[1:].cpu().reshape(3, bins)
        self.odds = own[0].clone()
        self._counts.copy_(own[1:])
