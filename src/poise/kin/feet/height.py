"""How high feet stand in one motion against another of the same skeleton."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from poise.kin.feet.contact import STAND_SPEED, lowest_and_slow, point_speed
from poise.motion import Clip

#: Frames of standing from which something is known.
ENOUGH = 3


def stands_higher(made: Clip, source: Clip, feet: Sequence[int]) -> float | None:
    """By how much (m) the joints `feet` are higher in `made` while they stand in both motions, the
    median; None where they hardly ever do."""
    frames = min(made.frames, source.frames)
    here, there = (torch.tensor(c.positions()[:frames][:, list(feet)]) for c in (made, source))
    apart: list[float] = []
    for k in range(len(feet)):
        stands = lowest_and_slow(there[:, k], source.fps)
        stands &= point_speed(here[:, k], made.fps) < STAND_SPEED
        apart += (here[:, k] - there[:, k])[stands, 2].tolist()
    return float(torch.tensor(apart).median()) if len(apart) >= ENOUGH else None
