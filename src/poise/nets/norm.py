"""Running mean and deviation of a stream, with a frozen copy that is used between updates."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

MIN_STD = 1e-4  # An entry that varies less is taken for a constant: it is shifted, not scaled.


class RunningNorm(nn.Module):
    """y = clip((x - mean) / std, -clip, clip) with statistics gathered in float64.

    `observe` only gathers; what `forward` uses changes at `freeze`, so that a rollout and the
    update that learns from it see the same function. Before the first `freeze`, y = clip(x).

    Args:
        size: width of the last dimension.
        clip: bound of |y|; infinity for none.
        window: number of samples that are remembered at most, for a stream that drifts; with None
            every sample counts the same for ever.

    With `fixed` set, new samples are ignored: networks that no longer learn keep what they were
    taught with.
    """

    count: Tensor
    mean: Tensor
    m2: Tensor
    shift: Tensor
    std: Tensor

    def __init__(self, size: int, clip: float = 5.0, window: float | None = None):
        super().__init__()
        self.clip, self.window, self.fixed = clip, window, False
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("m2", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    @torch.no_grad()
    def observe(self, x: Tensor) -> None:
        """Merges the samples `x (..., size)` into the statistics (Chan et al. 1979)."""
        x = x.reshape(-1, x.shape[-1]).double()
        mean_b = x.mean(0)
        self.merge(float(len(x)), mean_b, ((x - mean_b) ** 2).sum(0))

    def normalise(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised `x (N, size)`, and its sums for `add`, by fewer passes than `observe` takes.

        Sums `(2, size)` float32: of x - shift and of (x - shift)^2.
        """
        d = x - self.shift
        sums = torch.stack((d.sum(0), d.square().sum(0)))
        d.div_(self.std)
        return (d if math.isinf(self.clip) else d.clamp_(-self.clip, self.clip)), sums

    @torch.no_grad()
    def add(self, count: int, sums: Tensor) -> None:
        """Adds `count` samples by their sums `(2, size)`; the same as `observe` but for rounding.

        The rounding is that of float32 around the frozen mean, so there must have been a `freeze`.
        """
        first, second = sums.double() / count
        self.merge(count, self.shift + first, (second - first.square()).clamp_min(0.0) * count)

    @torch.no_grad()
    def merge(self, n_b: float, mean_b: Tensor, m2_b: Tensor) -> None:
        """Merges `n_b` samples of mean `mean_b` and summed squared deviation `m2_b`, `(size)` each."""
        if self.fixed:
            return
        # n = n_a + n_b;  d = mean_b - mean_a
        n_a = self.count
        n = n_a + n_b
        d = mean_b - self.mean
        # mean = mean_a + d n_b / n;  M2 = M2_a + M2_b + d^2 n_a n_b / n
        self.mean.add_(d * (n_b / n))
        self.m2.add_(m2_b + d * d * (n_a * n_b / n))
        if self.window is not None and float(n) > self.window:
            # Fewer samples with the same mean and variance: older ones fade away.
            self.m2.mul_(self.window / n)
            n = torch.full_like(n, self.window)
        self.count.copy_(n)

    @torch.no_grad()
    def freeze(self) -> None:
        """Takes the gathered statistics into use; without samples it changes nothing."""
        if self.fixed or float(self.count) == 0:
            return
        std = (self.m2 / self.count).sqrt()
        self.shift.copy_(self.mean)
        self.std.copy_(torch.where(std < MIN_STD, torch.ones_like(std), std))

    def forward(self, x: Tensor) -> Tensor:
        """Normalised values, the shape of `x (..., size)`."""
        y = (x - self.shift).div_(self.std)
        return y if math.isinf(self.clip) else y.clamp_(-self.clip, self.clip)

    def inverse(self, y: Tensor) -> Tensor:
        """x = y std + mean, for values inside the clip."""
        return y * self.std + self.shift
