"""Where episodes begin: which clip, and which of its frames."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.errors import PoiseError


class Starts:
    """Draws starts on the CPU, so that a seed means the same ones on every device.

    Args:
        length: `(C,)` frames of each clip.
        weights: `(C,)` odds with which clips are drawn; None: by their length in seconds.
        seed: of all draws.
        first: share of the starts that stand on frame 0; the others are uniform over the frames from
            which at least one step can be made (reference state initialisation).
    """

    def __init__(self, length: Tensor, weights: Tensor | None = None, seed: int = 0, first: float = 0.0):
        self.length, self.first = length.cpu(), first
        if not 0.0 <= first <= 1.0:
            raise PoiseError(f"the share of starts on frame 0 must lie in [0, 1], got {first}")
        self._weights = self._checked((self.length - 1).double() if weights is None else weights)
        self.rng = torch.Generator().manual_seed(seed)

    @property
    def weights(self) -> Tensor:
        """`(C,)` float64 on the CPU, a copy; set it to draw clips by other odds, such as those of
        `poise.learn.HardNegatives`. They need not sum to 1; clips of odds 0 are not drawn."""
        return self._weights.clone()

    @weights.setter
    def weights(self, odds: Tensor) -> None:
        self._weights = self._checked(odds)

    def _checked(self, odds: Tensor) -> Tensor:
        odds = odds.detach().double().cpu().clone()
        if odds.shape != self.length.shape:
            raise PoiseError(f"{len(self.length)} clips need as many odds, got {tuple(odds.shape)}")
        if not bool(odds.isfinite().all()) or bool((odds < 0).any()) or not float(odds.sum()) > 0:
            raise PoiseError("the odds of clips must be finite, not below 0 and not all 0")
        return odds

    def draw(self, count: int) -> tuple[Tensor, Tensor]:
        """(clip, frame) of `count` starts, `(count,)` each."""
        pick = torch.multinomial(self._weights, count, replacement=True, generator=self.rng)
        span = (self.length[pick] - 1).double()
        u = torch.rand(count, dtype=torch.float64, generator=self.rng)
        frame = torch.minimum((u * span).long(), self.length[pick] - 2)
        if self.first:
            frame[torch.rand(count, generator=self.rng) < self.first] = 0
        return pick, frame
