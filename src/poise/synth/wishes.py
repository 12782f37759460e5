"""What characters wish to do: a label of the library for some seconds, and then another one."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from poise.synth.codes import NEAREST, Codes

#: Labels with fewer codes are not wished for.
FEWEST = 2 * NEAREST


@dataclass(eq=False)
class Wishes:
    """Each world keeps to a label for some segments, half as many to half as many again, and then turns
    to another one, rather to one with a past like its own:

        p(l) ~ exp(-(d_l^2 - d_1^2) / (2 d_1^2)),

    with the distance d_l of its past from the nearest one of each label, d_1 the least of them.

    Attributes:
        codes: of the library. labels: `(L,)` those that are wished for.
        segments: mean number of segments for which one is kept to.
        worlds: how many there are.
        kind, left: `(N,)` the label of each world, -1 before the first; segments that are left of it.
    """

    codes: Codes
    labels: Tensor
    segments: float
    worlds: int = 1
    kind: Tensor = field(init=False)
    left: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.kind = torch.full((self.worlds,), -1)
        self.left = torch.zeros_like(self.kind)

    @classmethod
    def among(cls, codes: Codes | None, segments: float, worlds: int = 1) -> Wishes | None:
        """Those for the labels of a library; None where it has fewer than two."""
        if codes is None or codes.kinds is None:
            return None
        kinds, counts = codes.kinds[codes.kinds >= 0].unique(return_counts=True)
        labels = kinds[counts >= FEWEST]
        return cls(codes, labels, segments, worlds) if len(labels) > 1 else None

    def next(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        """The labels `(n,)` of the segments that follow the pasts `(n, p, D)`, in deviations, of worlds
        `ids (n,)`."""
        turns = self.left[ids] <= 0
        some = ids[turns]
        if len(some):
            apart = self.codes.apart(past[turns], self.labels).square()
            apart[self.labels == self.kind[some, None]] = torch.inf
            least = apart.amin(1, keepdim=True)
            share = (-(apart - least) / (2 * least.clamp_min(1e-6))).softmax(1)
            self.kind[some] = self.labels[torch.multinomial(share, 1, generator=rng).squeeze(1)]
            low, high = (max(1, round(k * self.segments)) for k in (0.5, 1.5))
            self.left[some] = torch.randint(low, high + 1, (len(some),), generator=rng)
        self.left[ids] -= 1
        return self.kind[ids]

    def rows(self) -> dict[str, Tensor]:
        """What each world wishes."""
        return {"kind": self.kind, "left": self.left}
