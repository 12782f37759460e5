"""Codes of a kinematic policy: what followed in its library, as a prior that knows the past."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

#: Frames of a past, counted from its end, by which it is compared with others.
COMPARED = (-1, -5, -12)
#: How many of the most similar pasts a code is drawn from.
NEAREST = 8


@dataclass(frozen=True, eq=False)
class Codes:
    """What followed in the library, as codes: a prior that knows the past.

    With N(0, I), the paper's, half of what is drawn is between what people do, so that motion dies down.
    Here z is that of what once followed one of the most similar pasts, with its encoder's noise,

        p(z | past) = sum_i w_i q_i(z),  w_i ~ exp(-(d_i^2 - d_1^2) / (2 T^2 d_1^2)),

    with distances d_1 <= d_2 <= ... of pasts, and the temperature T, by which the noise is scaled, too.

    Attributes:
        keys: `(K, 3 D)` of pasts, see `key_of`.
        mean, log_var: `(K, Z)` of q.
        weights: `(D)` of a frame's numbers, in deviations.
        kinds: `(K,)` which label the motion has, -1 for none; None where there are no labels.
    """

    keys: Tensor
    mean: Tensor
    log_var: Tensor
    weights: Tensor
    kinds: Tensor | None = None

    def only(self, kind: int) -> Codes:
        """Those of one label."""
        assert self.kinds is not None
        rows = self.kinds == kind
        return Codes(self.keys[rows], self.mean[rows], self.log_var[rows], self.weights)

    def key_of(self, past: Tensor) -> Tensor:
        """`(N, 3 D)` of pasts `(N, p, D)` in deviations: some of their frames, weighted."""
        picks = [max(k, -past.shape[1]) for k in COMPARED]
        return (past[:, picks] * self.weights).flatten(1)

    def draw(
        self, past: Tensor, count: int, rng: torch.Generator, temperature: float,
        kinds: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """`(N * count, Z)`: so many codes for each of the pasts `(N, p, D)`, in deviations; of labels
        `kinds (N,)` alone, if they are given."""
        near, index = self._nearest(past, NEAREST, kinds)
        least = near[:, :1].square().clamp_min(1e-6)
        share = (-(near.square() - least) / (2 * max(temperature, 1e-3) ** 2 * least)).softmax(-1)
        picks = torch.multinomial(share, count, replacement=True, generator=rng)
        code = index.gather(1, picks).flatten()
        noise = torch.randn(len(code), self.mean.shape[1], generator=rng)
        return self.mean[code] + temperature * (0.5 * self.log_var[code]).exp() * noise

    def wide(self, past: Tensor, count: int, kinds: Tensor | None = None) -> Tensor:
        """`(N * count, Z)`: the middles of the codes of the `count` most similar pasts, each once, over
        again where there are fewer."""
        near, index = self._nearest(past, count, kinds)
        turn = torch.arange(count) % near.isfinite().sum(1, keepdim=True).clamp_min(1)
        return self.mean[index.gather(1, turn).flatten()]

    def apart(self, past: Tensor, labels: Tensor) -> Tensor:
        """`(N, L)`: how far each past is from the most similar one of each label."""
        apart = torch.cdist(self.key_of(past), self.keys)
        return torch.stack([apart[:, self.kinds == k].amin(1) for k in labels.tolist()], 1)

    def _nearest(self, past: Tensor, count: int, kinds: Tensor | None) -> tuple[Tensor, Tensor]:
        """Distances and numbers `(N, count)` of the most similar pasts, the nearest first; those of
        another label are infinitely far."""
        apart = torch.cdist(self.key_of(past), self.keys)
        if kinds is not None:
            assert self.kinds is not None
            apart = apart.masked_fill(self.kinds != kinds[:, None], torch.inf)
        near, index = apart.topk(min(count, len(self.keys)), largest=False)
        return near, index
