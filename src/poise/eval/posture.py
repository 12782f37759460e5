"""Whether a motion was done, not only survived: the success rule, and the posture of every episode."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from poise.eval.rolloutset import RolloutSet
from poise.metrics import fallen, first_lasting, off_feet


class Posture(NamedTuple):
    """How episodes held themselves beside their references.

    Attributes:
        tracked: `(E,)` double, 1 where an episode succeeded and neither fell nor left its feet, else 0;
            NaN where no head is told.
        fallen_at: `(E,)` the frame from which on it was down for `LASTING_S` while its reference was
            upright, -1 for none; see `metrics.fallen`.
        off_feet_at: `(E,)` the same of its feet, see `metrics.off_feet`.
    """

    tracked: Tensor
    fallen_at: Tensor
    off_feet_at: Tensor


def posture(r: RolloutSet, won: Tensor, mask: Tensor) -> Posture:
    """The posture of every episode in the frames `mask (E, T)`. won: `(E,)` which succeeded."""
    none = torch.full_like(r.lengths.long(), -1)
    if r.head is None:
        return Posture(torch.full(won.shape, torch.nan, dtype=torch.float64), none, none)
    down = first_lasting(fallen(r.pos, r.ref_pos, r.head, r.root) & mask, r.fps)
    off = none
    if r.shapes is not None and r.feet:
        away = off_feet(r.pos, r.quat, r.ref_pos, r.ref_quat, r.shapes, r.feet)
        off = first_lasting(away & mask, r.fps)
    return Posture((won & (down < 0) & (off < 0)).double(), down, off)
