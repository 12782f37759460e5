"""Which foot swings when, in a gap between two keyframes: as few steps as there may be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from torch import Tensor

from poise.synth.steps import LEAST_M, SWING_S, SWING_S_PER_M

#: m that one step goes at most, and s that it has at least; most steps of a gap.
STRIDE_M, LEAST_S, MOST = 1.7, 0.22, 12
#: m; steps have time by their length and this.
SHORT_M = 0.4


class Swing(NamedTuple):
    """One foot in the air from `start` to `stop` s."""

    foot: int
    start: float
    stop: float


def planned(
    ways: Sequence[float], up: Tensor, seconds: float, first: int, more: tuple[int, int] = (0, 0)
) -> tuple[Swing, ...] | None:
    """Which foot swings when, as few steps as there may be; None where two feet cannot walk it.

    Args:
        ways: m that either foot must go. up: `(2, 2)` bool, in the air in either keyframe, by foot.
        first: the foot that steps first. more: steps more than it takes, of either foot.
    """
    if bool(up.all(1).any()):
        return None
    need = [
        max(int(np.ceil(way / STRIDE_M)) if way > LEAST_M else 0, int(up[0, k]), int(up[1, k]))
        for k, way in enumerate(ways)
    ]
    # A foot that is in the air at both ends comes down between them, if there is time.
    need = [
        m + 1 if bool(up[:, k].all()) and m < 2 and seconds > 2 * SWING_S else m
        for k, m in enumerate(need)
    ]
    need = [m + x for m, x in zip(need, more, strict=True)]
    for n in range(MOST + 1):
        order = [first if i % 2 == 0 else 1 - first for i in range(n)]
        fits = all(order.count(k) >= need[k] for k in (0, 1))
        starts = not bool(up[0].any()) or (n > 0 and bool(up[0, order[0]]))
        ends = not bool(up[1].any()) or (n > 0 and bool(up[1, order[-1]]))
        if fits and starts and ends:
            return _timed(order, ways, up, seconds)
    return None


def _timed(
    order: list[int], ways: Sequence[float], up: Tensor, seconds: float
) -> tuple[Swing, ...] | None:
    n = len(order)
    # A longer step has more of the time, one that is under way in a keyframe about half of it.
    shares = [SHORT_M + ways[k] / order.count(k) for k in order]
    if n and bool(up[0].any()):
        shares[0] *= 0.6
    if n and bool(up[1].any()):
        shares[-1] *= 0.6
    slot = seconds / max(sum(shares), 1e-9)
    if (n and slot * min(shares) < 0.6 * LEAST_S) or seconds < n * LEAST_S:
        return None
    out, at = [], 0.0
    for i, (foot, share) in enumerate(zip(order, shares, strict=True)):
        each = ways[foot] / order.count(foot)
        whole = slot * share
        lasts = min(0.98 * whole, SWING_S + SWING_S_PER_M * each)
        start = at + 0.5 * (whole - lasts)
        if i == 0 and bool(up[0].any()):
            start = 0.0
        if i == n - 1 and bool(up[1].any()):
            start = seconds - lasts
        out.append(Swing(foot, start, start + lasts))
        at += whole
    return tuple(out)
