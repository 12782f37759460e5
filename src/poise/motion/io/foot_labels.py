"""Labels of files that say when heels and toes touch the floor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.roles import SIDES, find_roles

#: How arrays of labels are called: `(T, 4)` for left heel, left toe, right heel and right toe, as Kimodo
#: and HumanML3D have them, or `(T, 2)` for the left and the right foot.
KEYS = ("foot_contacts", "foot_contact")
#: Labels that are no truth values hold from here on; they lie within this much of 0 to 1.
HOLDS, BEYOND = 0.5, 0.5
NOTE = "The file says when the feet touch the floor: that is taken in place of a guess"
_OUT = "Its labels of foot contacts were left out"


def with_labels(clip: Clip, data: Mapping[str, Any]) -> Clip:
    """The clip with the labels of foot contacts that named arrays bring, as it is without any."""
    key = next((key for key in KEYS if key in data), None)
    return clip if key is None else labelled(clip, data[key])


def labelled(clip: Clip, value: object) -> Clip:
    """The clip with labels of its feet's contacts, `(T, 4)` or `(T, 2)`, and a note; what says nothing
    is left out, and a note says why."""
    contacts, note = _contacts(clip, np.asarray(value))
    notes = (*clip.skeleton.source.notes, note)
    return clip.replaced(skeleton=clip.skeleton.with_source(notes=notes), contacts=contacts)


def _contacts(clip: Clip, table: np.ndarray) -> tuple[tuple[tuple[int, np.ndarray], ...], str]:
    shapes = [(clip.frames, width) for width in (4, 2)]
    if table.shape not in shapes or table.dtype.kind not in "biuf":
        there = " x ".join(map(str, table.shape))
        return (), f"{_OUT}: they are {there}, not {clip.frames} x 4 truth values"
    numbers = table.astype(np.float64)
    if not ((numbers >= -BEYOND) & (numbers <= 1.0 + BEYOND)).all():
        return (), f"{_OUT}: they do not lie between 0 and 1"
    touch = numbers >= HOLDS
    if not touch.any():
        return (), f"{_OUT}: by them no foot ever touches the floor"
    try:
        roles = find_roles(clip.skeleton)
    except PoiseError:
        return (), f"{_OUT}: no joint is known as a foot"
    feet = [roles.joint(f"{side}_foot") for side in SIDES]
    if None in feet:
        return (), f"{_OUT}: no joint is known as a foot"
    half = np.repeat(touch, 2, axis=1) if touch.shape[1] == 2 else touch
    return tuple((j, half[:, 2 * k : 2 * k + 2]) for k, j in enumerate(feet) if j is not None), NOTE
