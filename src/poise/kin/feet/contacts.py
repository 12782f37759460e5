"""Which foot stands when, told from a motion alone."""

from __future__ import annotations

from collections.abc import Sequence

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


def standing_labels(
    clips: Sequence[Tensor], fps: float, above: float = 0.04, speed: float = 0.35
) -> list[Tensor]:
    """Contact `(T, F)` bool of the foot joints `(T, F, 3)` m of each clip, at heights told by the clips.

    Rules that know only steps (`motion.windows.step_contacts`) hardly ever find a foot standing in
    recordings whose feet slide by a few centimetres per second. Here a joint's own standing height, the
    lowest tenth of its slow frames in all clips, counts, and per clip within 4 cm below and 6 cm above
    of it, since floors differ; low is what is less than `above` m above that, slow as in
    `contact_labels`.
    """
    usual = torch.stack([_standing(torch.cat([_slow(c[:, k], fps, speed) for c in clips]))
                         for k in range(clips[0].shape[1])])  # fmt: skip
    out = []
    for points in clips:
        own = points[..., 2].quantile(0.1, dim=0)
        limits = own.clamp(usual - 0.04, usual + 0.06) + above
        # Each joint has a floor of its own.
        lowered = points.clone()
        lowered[..., 2] -= limits
        out.append(contact_labels(lowered, fps, 0.0, speed))
    return out


def _slow(points: Tensor, fps: float, speed: float) -> Tensor:
    """Heights of those of the points `(T, 3)` that hardly move to the next frame."""
    moved = torch.diff(points, dim=0).norm(dim=-1) * fps
    return points[1:, 2][moved < speed]


def _standing(heights: Tensor) -> Tensor:
    if not len(heights):
        return torch.zeros((), dtype=heights.dtype)
    return heights.kthvalue(1 + len(heights) // 10).values
