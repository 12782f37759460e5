"""Which foot stands when, told from a motion alone."""

from __future__ import annotations

import torch
from torch import Tensor


def contact_labels(
    points: Tensor, fps: float, height: float = 0.05, speed: float = 0.35, ground: float = 0.0
) -> Tensor:
    """Contact `(T, F)` bool of foot points `(T, F, 3)` m: low and slow.

    A point is in contact when it is lower than `height` m above `ground` and moves slower than
    `speed` m/s (central difference). Gaps and spells of a single frame are closed.
    """
    frames = len(points)
    ahead = torch.arange(frames).add(1).clamp(max=frames - 1)
    behind = torch.arange(frames).sub(1).clamp(min=0)
    dt = (ahead - behind).to(points.dtype)[:, None, None] / fps
    slow = ((points[ahead] - points[behind]) / dt).norm(dim=-1) < speed
    label = slow & (points[..., 2] < ground + height)
    if frames >= 3:
        before, now, after = label[:-2], label[1:-1], label[2:]
        # Majority of three frames.
        middle = (before & now) | (now & after) | (before & after)
        label = torch.cat((label[:1], middle, label[-1:]), 0)
    return label
