"""Labels of files that say when heels and toes touch the floor."""

from __future__ import annotations

import numpy as np

from poise.motion.clip import Clip
from poise.motion.io.text import shown

#: Labels that are no truth values hold from here on; they lie within this much of 0 to 1.
HOLDS, BEYOND = 0.5, 0.5
NOTE = "The file says when heels and toes touch the floor: that is taken in place of a guess"


def foot_labels(value: object, frames: int) -> tuple[np.ndarray | None, str]:
    """Labels `(T, 4)` bool of left heel, left toe, right heel, right toe, and a note; None where there
    is nothing that says anything, and a note why."""
    table = np.asarray(value)
    if table.shape != (frames, 4) or table.dtype.kind not in "biuf":
        what = "x".join(map(str, table.shape))
        return None, f"Its labels of foot contacts were left out: they are {shown(what)}, not {frames}x4"
    numbers = table.astype(np.float64)
    if not ((numbers >= -BEYOND) & (numbers <= 1.0 + BEYOND)).all():
        return None, "Its labels of foot contacts were left out: they do not lie between 0 and 1"
    if not (numbers >= HOLDS).any():
        return None, "Its labels of foot contacts were left out: no foot ever touches the floor by them"
    return numbers >= HOLDS, NOTE


def labelled(clip: Clip, labels: np.ndarray | None, note: str, feet: tuple[str, str]) -> Clip:
    """The clip with labels `(T, 4)` of its left and right foot joint, where it has all of their frames,
    and the note."""
    notes = (*clip.skeleton.source.notes, note)
    contacts = ()
    if labels is not None and len(labels) == clip.frames:
        joints = [clip.skeleton.names.index(name) for name in feet]
        contacts = ((joints[0], labels[:, :2]), (joints[1], labels[:, 2:]))
    elif labels is not None:
        return clip
    skeleton = clip.skeleton.with_source(notes=notes)
    return clip.replaced(skeleton=skeleton, contacts=contacts)
