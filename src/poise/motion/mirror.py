"""Motion seen in a mirror that stands upright between left and right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.noise import side_pairs
from poise.motion.skeleton import triple
from poise.motion.vectors import norm

#: A rest pose is not upright if its sides differ in height by more than this share of their distance.
_LEVEL = 0.2


def other_sides(names: tuple[str, ...], parents: tuple[int, ...]) -> np.ndarray:
    """For each joint the one on the other side `(J)`, itself for those in the middle.

    Raises:
        PoiseError: no joint's name tells a side, or the sides have different hierarchies.
    """
    other = np.arange(len(names))
    for left, right, _ in side_pairs(names):
        other[left], other[right] = right, left
    if bool((other == np.arange(len(names))).all()):
        raise PoiseError(
            "no joint's name tells left from right",
            hint="Name joints LeftArm, RightArm",
            code="sides-unknown",
        )
    for j, parent in enumerate(parents):
        if parent >= 0 and int(other[parent]) != parents[int(other[j])]:
            raise PoiseError(
                f"'{names[j]}' and '{names[int(other[j])]}' hang on different joints",
                code="mirror-unknown",
            )
    return other


def mirrored_clip(clip: Clip) -> Clip:
    """A clip in a mirror, on bones in a mirror; see `synthesis.windows.mirrored`.

    The mirror stands between left and right as they lie at rest, or, in a skeleton with a rest that is
    not upright, across the y axis; another mirror only changes the way that the clip goes.

    Raises:
        PoiseError: sides that are not named.
    """
    skeleton = clip.skeleton
    other = other_sides(skeleton.names, skeleton.parents)
    offsets = skeleton.offsets
    try:
        normal = level_normal(skeleton.names, skeleton.parents, offsets[None])
    except PoiseError:
        normal = np.array([0.0, 1.0, 0.0], dtype=float)
    mirror = np.eye(3) - 2 * np.outer(normal, normal)
    root, rot = clip.root_pos, clip.rot
    rot = np.concatenate((rot[:, other, :1], -(rot[:, other, 1:] @ mirror)), -1)
    ends = tuple((int(other[j]), triple(np.array(v) @ mirror)) for j, v in skeleton.ends)
    seen = replace(skeleton, offsets=(offsets[other] @ mirror), ends=ends)
    contacts = tuple((int(other[j]), touch) for j, touch in clip.contacts)
    made = clip.replaced(skeleton=seen, root_pos=(root @ mirror), rot=rot)
    return made.replaced(contacts=contacts)


def level_normal(names: tuple[str, ...], parents: tuple[int, ...], offsets: np.ndarray) -> np.ndarray:
    """The level unit vector from the right to the left at rest `offsets (C, J, 3)`, float64."""
    rest = offsets.astype(float)
    rest[:, 0] = 0.0
    for j, parent in enumerate(parents):
        if parent >= 0:
            rest[:, j] += rest[:, parent]
    apart = np.zeros(3)
    for left, right, _ in side_pairs(names):
        apart = apart + (rest[:, left] - rest[:, right]).mean(0)
    level = apart * np.array([1.0, 1.0, 0.0], dtype=float)
    if float(norm(level)) < 1e-6 or abs(float(apart[2])) > _LEVEL * float(norm(level)):
        raise PoiseError(
            "the skeleton's left and right do not lie level at rest, so no mirror is known",
            code="mirror-unknown",
        )
    return level / norm(level)
