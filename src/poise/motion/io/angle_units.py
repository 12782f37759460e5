"""Angles that cannot be in the unit that a file states, or its format has."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from poise.errors import PoiseError

_TURN = 2.0 * np.pi
#: Share of the frames in which a joint must be turned by more than a whole turn; a few may be damaged.
_OFTEN = 0.05
#: A motion in radians read as degrees keeps every angle below this (degrees) ...
_FEW_DEG = 3.5
#: ... although two joints and more turn by this (radians) at least, if they are radians.
_MOVES_RAD, _JOINTS = 0.35, 2


def check_radians(angles: Mapping[str, np.ndarray], stated: str, path: Path, hint: str) -> None:
    """Refuses radians of which one turns a joint by more than a whole turn again and again: degrees.

    Args:
        angles: `(T, ...)` rad by the joint's name. Roots, which may turn often, are left out.
        stated: what tells that they are radians, for the sentence. hint: what to change.

    Raises:
        PoiseError: naming the joint, the frame and the value.
    """
    worst = ("", 0, 0.0)
    for name, values in angles.items():
        if not values.size:
            continue
        size = np.abs(values).reshape(len(values), -1).max(-1)
        if (size > _TURN).mean() >= _OFTEN and size.max() > worst[2]:
            worst = (name, int(size.argmax()), float(size.max()))
    if worst[0]:
        name, frame, value = worst
        raise PoiseError(
            f"'{name}' is {value:.4g} at frame {frame}, {value / _TURN:.1f} whole turns of a joint in "
            f"radians, which {stated}: the angles seem to be degrees",
            path,
            hint,
        )


def few_degrees(angles: Mapping[str, np.ndarray]) -> tuple[str, float] | None:
    """The joint that moves most and its largest angle, if angles that are said to be degrees look like
    radians: all are tiny, and several joints would move well if they were radians.

    angles: `(T, ...)` by the joint's name, without roots.
    """
    tables = {n: v.reshape(len(v), -1) for n, v in angles.items() if v.size}
    if not tables or max(np.abs(v).max() for v in tables.values()) > _FEW_DEG:
        return None
    moves = {n: float(np.ptp(v, axis=0).max()) for n, v in tables.items()}
    if sum(x > _MOVES_RAD for x in moves.values()) < _JOINTS:
        return None
    most = max(moves, key=moves.__getitem__)
    return most, float(np.abs(tables[most]).max())


def few_degrees_note(angles: Mapping[str, np.ndarray]) -> list[str]:
    """The sentence about angles in degrees that look like radians, for formats that state no unit."""
    found = few_degrees(angles)
    if found is None:
        return []
    return [
        f"No joint turns by more than {_FEW_DEG:g} degrees ('{found[0]}' most, to {found[1]:.3g}): the "
        "angles look like radians, but were read as degrees, as the format has them (uncertain; write "
        "degrees)"
    ]
