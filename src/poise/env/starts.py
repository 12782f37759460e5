"""Starts of episodes: a clip, and one of its frames."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from poise.env.bins import MotionBins
from poise.errors import PoiseError

#: An episode that practises a motion bin begins at most so many bin lengths before the bin's middle.
RUN_UP = 2.0


class Starts:
    """Draws starts on the CPU, so that a seed means the same ones on every device.

    Args:
        length: `(C,)` frames of each clip.
        weights: `(C,)` odds with which clips are drawn; None: by their length in seconds.
        seed: of all draws.
        first: share of the starts that stand on frame 0; the others are uniform over the frames from
            which at least one step can be made (reference state initialisation).
        bins: of the clips, where some are practised more than others, see `draw`.
        hard: share of the starts (before those on frame 0 are taken) that adaptive sampling draws.
        over: whether adaptive sampling draws among the motion bins of the drawn "clip", or of the whole
            "library", so that clips are drawn by how often they fail.
    """

    def __init__(
        self,
        length: Tensor,
        weights: Tensor | None = None,
        seed: int = 0,
        first: float = 0.0,
        bins: MotionBins | None = None,
        hard: float = 0.0,
        over: Literal["clip", "library"] = "clip",
    ):
        self.length, self.first, self.hard, self.over = length.cpu(), first, hard, over
        self.bins = None if bins is None else bins.to(torch.device("cpu"))
        for what, share in (("on frame 0", first), ("by adaptive sampling", hard)):
            if not 0.0 <= share <= 1.0:
                raise PoiseError(
                    f"the share of starts {what} must lie in [0, 1], got {share}", code="out-of-range"
                )
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
            raise PoiseError(
                f"{len(self.length)} clips need as many odds, got {tuple(odds.shape)}",
                code="bad-weights",
            )
        if not bool(odds.isfinite().all()) or bool((odds < 0).any()) or not float(odds.sum()) > 0:
            raise PoiseError(
                "the odds of clips must be finite, not below 0 and not all 0", code="bad-weights"
            )
        return odds

    def draw(self, count: int, odds: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(clip, frame) of `count` starts, `(count,)` each.

        odds: `(G,)` float64 of the motion bins, such as `AdaptiveSampling.odds`. The share `hard` of the
            starts lies in the `RUN_UP` before the middle of a bin that is drawn by them among those of
            its clip, or of all clips of odds above 0; where all are 0 an episode begins as without.
        """
        pick = torch.multinomial(self._weights, count, replacement=True, generator=self.rng)
        span = (self.length[pick] - 1).double()
        u = torch.rand(count, dtype=torch.float64, generator=self.rng)
        frame = torch.minimum((u * span).long(), self.length[pick] - 2)
        if self.hard and odds is not None and self.bins is not None:
            pick, frame = self._practise(self.bins, pick, frame, odds)
        if self.first:
            frame[torch.rand(count, generator=self.rng) < self.first] = 0
        return pick, frame

    def _practise(
        self, m: MotionBins, pick: Tensor, frame: Tensor, odds: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Some of the starts anew, before motion bins that are drawn by their odds."""
        chance, where, before = torch.rand(3, len(pick), dtype=torch.float64, generator=self.rng)
        if self.over == "library":
            # Those of clips that are not drawn at all are not practised either.
            odds = torch.where(self._weights[m.clip] > 0, odds, 0.0)
            first, last = torch.zeros_like(pick), torch.full_like(pick, len(m) - 1)
        else:
            first, last = m.offset[pick], m.offset[pick] + m.count[pick] - 1
        summed = torch.cat((odds.new_zeros(1), odds.cumsum(0)))
        low, high = summed[first], summed[last + 1]
        # Rounding must not lead out of the clip.
        found = torch.searchsorted(summed, low + where * (high - low), right=True) - 1
        bin = torch.minimum(torch.maximum(found, first), last)
        clip, size = m.clip[bin], m.size[bin].double()
        begun = (m.begin[bin] + (0.5 - before * RUN_UP) * size).long().clamp(min=0)
        begun = torch.minimum(begun, self.length[clip] - 2)
        hard = (chance < self.hard) & (high > low)
        return torch.where(hard, clip, pick), torch.where(hard, begun, frame)
