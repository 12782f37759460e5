"""What predicted motion costs beside tracking: jerk of the bodies, sliding of the soles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.metrics.plausibility import foot_contacts, jerk
from poise.metrics.shapes import Shapes, foot_points

#: m/s^3, the mean jerk below which a reference counts as calm.
CALM = 50.0


@dataclass(frozen=True, eq=False)
class Roughness:
    """How roughly K motions of T frames go, by the score card's own measures.

    Attributes:
        jerk: `(K, T')` m/s^3, mean over the bodies, from frame to frame.
        slide: `(K, T - 1)` m/s with which points of the soles that touch the ground move along it,
            summed over the points and divided by half their number.
    """

    jerk: Tensor
    slide: Tensor

    @classmethod
    def of(
        cls, pos: Tensor, quat: Tensor, past: Tensor, shapes: Shapes, feet: Sequence[int], rate_hz: float
    ) -> Roughness:
        """Measures predictions.

        Args:
            pos: `(K, T, B, 3)` m, world positions of the bodies, the first where they are now.
            quat: `(K, T, B, 4)` wxyz.
            past: `(K, k, B, 3)` m, up to three frames before them; `(1, k, B, 3)` where all share them.
            shapes: the solids of the bodies.
            feet: indices of the feet among the bodies.
            rate_hz: frames a second.
        """
        whole = torch.cat((past.expand(len(pos), -1, -1, -1), pos), 1)
        speed, contact = foot_contacts(foot_points(pos, quat, shapes, feet), rate_hz)
        slide = (speed * contact).sum(-1) / 1000.0 / (speed.shape[-1] / 2)
        few = whole.shape[1] < 4
        return cls(slide[:, :0] if few else jerk(whole, rate_hz), slide)

    def price(self, reference: Roughness, jerk_price: float, slide_price: float) -> Tensor:
        """`(K,)`, what these motions cost beside references `(G, ...)`, each that of K / G of them,

            jerk_price sum_t j_t / max(mean j_ref, CALM) + slide_price sum_t max(0, s_t - mean s_ref),

        with the jerk j and the slide s, so that a leap may be as jerky as a leap is, and standing feet
        stand.
        """
        if not self.slide.shape[1]:
            return torch.zeros(len(self.slide))
        each = len(self.slide) // len(reference.slide)
        slid = reference.slide.mean(1, keepdim=True).repeat_interleave(each, 0)
        price = slide_price * (self.slide - slid).clamp_min(0.0).sum(1)
        if self.jerk.shape[1]:
            source = torch.full((len(price),), CALM)
            if reference.jerk.shape[1]:
                source = reference.jerk.mean(1).clamp_min(CALM).repeat_interleave(each)
            price = price + jerk_price / source * self.jerk.sum(1)
        return price
