"""Means and quantiles over the valid frames of padded rollouts."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.errors import PoiseError


def span_mask(mask: Tensor, order: int) -> Tensor:
    """Which of the `T - order` differences of order `order` use valid frames only.

    mask: `(..., T)` bool. Returns `(..., T - order)` bool, aligned with `torch.diff(x, n=order)`.
    """
    frames = mask.shape[-1]
    out = mask[..., : max(frames - order, 0)]
    for k in range(1, order + 1):
        out = out & mask[..., k : max(frames - order, 0) + k]
    return out


def masked_mean(
    x: Tensor, mask: Tensor | None = None, dim: int | tuple[int, ...] | None = None
) -> Tensor:
    """Mean of `x` where `mask` (of the same shape) holds; NaN where nothing is valid.

    Values under a false mask may be anything, NaN too. `dim=None` reduces everything.
    """
    dims = tuple(range(x.ndim)) if dim is None else dim
    if mask is None:
        mask = torch.ones_like(x, dtype=torch.bool)
    if mask.shape != x.shape:
        raise PoiseError(f"the mask has shape {tuple(mask.shape)}, the values {tuple(x.shape)}")
    total = torch.where(mask, x, torch.zeros_like(x)).sum(dims)
    return total / mask.sum(dims)


def masked_quantile(x: Tensor, q: float, mask: Tensor | None = None) -> Tensor:
    """The quantile `q` in [0, 1] of all valid values, linear between neighbours; NaN without any."""
    values = (x.reshape(-1) if mask is None else x[mask]).sort().values
    if values.numel() == 0:
        return x.new_tensor(float("nan"))
    place = q * (values.numel() - 1)
    low = int(place)
    high = min(low + 1, values.numel() - 1)
    return values[low] + (place - low) * (values[high] - values[low])
