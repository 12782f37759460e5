"""Feet that step in a transition: where a step is missing it is put in, and feet that swing are clear.

A network may say that a foot stands all through a gap while the keyframes at its ends have it in two
places. Held at both it would slide from one to the other; here it takes a step instead. And what it is
unsure of it averages, so that a foot that swings hardly leaves the floor; here it does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from poise.kin.series import find_runs

#: Below this distance (m) of ankle or toes, whichever is less, a foot shuffles, turns or rolls.
LEAST_M = 0.05
#: Seconds that a step takes: those of a short one, and more for every metre.
SWING_S, SWING_S_PER_M = 0.3, 0.15
#: How far (m) the lowest end of a foot is above the floor in the middle of a swing: the median of 580
#: swings of CMU clips, of all lengths from 0.1 to 1.5 m.
CLEAR_M = 0.05
#: What a step may have of the gap, and what is left standing at its ends, in frames.
_MOST_OF_GAP, _EDGE_FRAMES = 0.45, 2
#: The share of a swing, about its middle, in which a foot must be clear.
_MIDDLE = 0.6


class Step(NamedTuple):
    """A foot swings in the frames `start` to `stop` (exclusive)."""

    foot: int
    start: int
    stop: int


def missing_steps(soles: Tensor, stands: Tensor, fps: float) -> tuple[Step, ...]:
    """The steps that must be taken for feet to stand where both ends of a gap have them.

    Args:
        soles: `(T, K, 2, 3)` m, ankles and toes of K feet, the first and last frame being kept ones.
        stands: `(T, K)` bool.

    A foot that stands in all frames and is farther than `LEAST_M` from where it was swings while the
    other feet stand, and as near as can be to when the transition moves it. Of several the one that is
    moved first steps first.
    """
    (frames, feet), ankles = soles.shape[:2], soles[:, :, 0]
    apart = (soles[-1, ..., :2] - soles[0, ..., :2]).norm(dim=-1).amin(-1)
    wanting = [k for k in range(feet) if bool(stands[:, k].all()) and apart[k] > LEAST_M]
    stands = stands.clone()
    found: list[Step] = []
    for k in sorted(wanting, key=lambda k: _moved(ankles[:, k])):
        seconds = SWING_S + SWING_S_PER_M * float(apart[k])
        length = round(min(seconds * fps, _MOST_OF_GAP * frames))
        if length < 2 or frames < length + 2 * _EDGE_FRAMES:
            continue
        others = [j for j in range(feet) if j != k]
        later = len(wanting) - len(found) - 1
        start = _when(_moved(ankles[:, k]), ~stands[:, others].all(1), length, later)
        found.append(Step(k, start, start + length))
        stands[start : start + length, k] = False
    return tuple(found)


def stepping(stands: Tensor, steps: Sequence[Step], columns: Sequence[Sequence[int]]) -> Tensor:
    """Contacts `(T, F)` with the feet of `steps` off the floor; columns: those of every foot."""
    stands = stands.clone()
    for step in steps:
        stands[step.start : step.stop, list(columns[step.foot])] = False
    return stands


def rises(soles: Tensor, stands: Tensor) -> Tensor:
    """`(T, K)` m, how much higher feet must be for each to be `CLEAR_M` clear of the floor in mid-swing.

    Args:
        soles: `(T, K, 2, 3)` m, of a gap with one kept frame at each end.
        stands: `(T, K)` bool.

    The floor is at the lowest place of each end of the foot. Of a swing by more than `LEAST_M` the
    height h(t) above it is to be at least `CLEAR_M sin(pi t)`, by A sin^2(pi t) more.
    """
    height = soles[..., 2] - soles[..., 2].amin(0)
    low, up = height.amin(-1), torch.zeros(stands.shape, dtype=soles.dtype)
    free = ~stands
    free[[0, -1]] = False
    for k in range(stands.shape[1]):
        for first, last in find_runs(free[:, k].numpy(), 0):
            gone = soles[last + 1, k, :, :2] - soles[first - 1, k, :, :2]
            if gone.norm(dim=-1).amin() <= LEAST_M:
                continue
            count = last - first + 1
            t = torch.arange(1, count + 1, dtype=soles.dtype) / (count + 1)
            arc = torch.sin(torch.pi * t)
            short = (CLEAR_M * arc - low[first : last + 1, k]) / arc**2
            inner = (t - 0.5).abs() <= 0.5 * _MIDDLE
            if bool(inner.any()):
                up[first : last + 1, k] = short[inner].amax().clamp(0, CLEAR_M) * arc**2
    return up


def _moved(path: Tensor) -> float:
    """The frame by which half of the way `(T, 3)` is done."""
    way = torch.diff(path[:, :2], dim=0).norm(dim=-1).cumsum(0)
    return float((way < 0.5 * way[-1]).sum())


def _when(middle: float, busy: Tensor, length: int, later: int) -> int:
    """Where a step of `length` frames begins: with little of it while other feet are in the air (`busy`
    `(T)`), room after it for `later` more steps, then near `middle`."""
    frames = len(busy)
    last = max(_EDGE_FRAMES, frames - _EDGE_FRAMES - (later + 1) * length)
    starts = torch.arange(_EDGE_FRAMES, last + 1)
    in_air = torch.cat((torch.zeros(1), busy.double().cumsum(0)))
    clash = in_air[starts + length] - in_air[starts]
    off = (starts + 0.5 * length - middle).abs() / frames
    return int(starts[(clash + off).argmin()])
