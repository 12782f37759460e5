"""Which episodes succeeded, which of their frames count, and sums of figures over those."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from poise.eval.card import NAN, Weighting
from poise.eval.rolloutset import RolloutSet
from poise.metrics import SuccessRule, success


class Judged(NamedTuple):
    """won `(E,)`: reached the end and broke the rule in no frame. mask `(E, T)`: the frames that count,
    up to and including the first that broke the rule, since what comes after is not tracking. failed_at
    `(E,)`: the frame of failure, -1 for none; the last one where an episode was stopped early.
    """

    won: Tensor
    mask: Tensor
    failed_at: Tensor


def judge(r: RolloutSet, rule: SuccessRule) -> Judged:
    """Judges every episode by `rule`; a state that is not finite fails and counts in no figure."""
    valid = r.valid
    frame = torch.arange(r.pos.shape[1], device=r.pos.device)
    outcome = success(
        r.pos,
        r.ref_pos,
        torch.where(valid, frame + 1, 0).amax(1),
        rule,
        bodies=r.rule_bodies,
        root=r.root,
        ref_min_height=r.ref_min_height,
    )
    won = outcome.success & r.reached_end.bool() & valid.any(1)
    last = torch.where(outcome.first_fail >= 0, outcome.first_fail, r.pos.shape[1])
    # A state that blew up is a failure, not a number to average.
    finite = r.pos.isfinite().flatten(2).all(2) & r.quat.isfinite().flatten(2).all(2)
    mask = valid & finite & (frame <= last.unsqueeze(-1))
    # An episode that was stopped without breaking the rule failed at its last valid frame.
    stopped = torch.where(outcome.first_fail >= 0, outcome.first_fail, valid.sum(1) - 1)
    return Judged(won, mask, torch.where(won, -1, stopped))


@dataclass(frozen=True, eq=False)
class Sums:
    """Sum and count of one figure per episode, so that either weighting is a division away."""

    total: Tensor
    count: Tensor

    @staticmethod
    def of(values: Tensor, mask: Tensor) -> Sums:
        """From `(E, ...)` values under a mask of the same shape."""
        kept = torch.where(mask, values, torch.zeros_like(values)).double()
        return Sums(kept.flatten(1).sum(1), mask.flatten(1).sum(1))

    @staticmethod
    def cat(parts: Sequence[Sums]) -> Sums:
        """Of the episodes of all parts, one after another."""
        return Sums(torch.cat([p.total for p in parts]), torch.cat([p.count for p in parts]))

    def mean(self, rows: Tensor, weighting: Weighting) -> float:
        """Over the episodes `rows (E,)` bool; NaN when they hold no sample."""
        rows = rows & (self.count > 0)
        if not bool(rows.any()):
            return NAN
        total, count = self.total[rows], self.count[rows]
        return float(total.sum() / count.sum() if weighting == "frame" else (total / count).mean())
