"""Keyframes as a user gives them, and the gaps between them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from poise.errors import PoiseError


class Gap(NamedTuple):
    """Frames a and b are known, those between are made."""

    a: int
    b: int


def check_keyframes(keyframes: Sequence[int], frames: int, where: str | None = None) -> tuple[int, ...]:
    """The keyframes, if they are at least two, within the clip, different and in rising order.

    Raises:
        PoiseError: what is wrong with them, in one sentence.
    """
    keys = tuple(keyframes)
    if len(keys) < 2:
        raise PoiseError(f"in-betweening needs at least 2 keyframes, got {len(keys)}", where)
    for k in keys:
        if not 0 <= k < frames:
            raise PoiseError(
                f"keyframe {k} is out of range", where, f"The clip has frames 0 to {frames - 1}"
            )
    for a, b in pairwise(keys):
        if a == b:
            raise PoiseError(f"keyframe {a} is given twice", where, "Give every keyframe once")
        if a > b:
            raise PoiseError(f"keyframe {b} comes after {a}", where, "Give keyframes in rising order")
    return keys


def split_gaps(keyframes: Sequence[int], longest: float) -> tuple[list[Gap], list[int], list[str]]:
    """Gaps of at most `longest` frames between known ones, frames at which longer ones are split, and a
    warning for each of those."""
    gaps: list[Gap] = []
    inserted: list[int] = []
    warnings: list[str] = []
    for a, b in pairwise(keyframes):
        if b - a < 2:
            continue
        parts = 1
        while (b - a) / parts - 1 > longest:
            parts += 1
        marks = [a + round(k * (b - a) / parts) for k in range(parts + 1)]
        inserted += marks[1:-1]
        if parts > 1:
            at = ", ".join(map(str, marks[1:-1]))
            warnings.append(
                f"The gap from {a} to {b} is longer than the {longest:.0f} frames the model was trained "
                f"for; it was split at {at}, where the pose is interpolated"
            )
        gaps += [Gap(x, y) for x, y in pairwise(marks) if y - x > 1]
    return gaps, inserted, warnings
