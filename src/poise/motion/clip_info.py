"""A clip in a few numbers: rate, length, unit, the person's height, its guesses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from poise.motion.clip import Clip
from poise.motion.skeleton import line_to_root

#: Words of bones that control others, such as "ik_foot_l", and are no joints of a body.
_CONTROLS = re.compile(r"(^|[^a-z])(ik|ctrl|control|target|pole)([^a-z]|$)")
_NOT_JOINTS = ("end", "nub", "top", "tip", "mesh", "index")
# Ankle to head joint along the bones, and ankle to neck, as shares of a person's height.
# The way runs through the hip's width, so it is a little longer than the upright distance.
# Of so many joints all pairs are measured.
_PAIRWISE = 256
_HEAD_SHARE, _NECK_SHARE = 0.92, 0.80


def landmarks(names: Sequence[str]) -> tuple[list[int], list[int], list[int]]:
    """Indices of the joints that their names tell to be head, neck and ankles."""
    low = [n.lower().rsplit(":", 1)[-1] for n in names]
    usable = [not any(word in n for word in _NOT_JOINTS) and not _CONTROLS.search(n) for n in low]

    def named(*words: str) -> list[int]:
        return [j for j, n in enumerate(low) if usable[j] and any(w in n for w in words)]

    return named("head"), named("neck"), named("ankle") or named("foot")


def body_height(
    names: Sequence[str], parents: Sequence[int], offsets: np.ndarray, positions: np.ndarray
) -> tuple[float, str]:
    """A person's standing height in the unit of its arguments, and how it was found.

    With a head (or neck) and ankles known by name, from the bone lengths between them; so rest
    pose and vertical do not matter. Otherwise the largest distance between two joints in
    `positions (S, J, 3)`, a sample of posed frames: arm span or height.
    """
    heads, necks, ankles = landmarks(names)
    lengths = np.linalg.norm(offsets, axis=-1)
    tops = heads or necks
    if tops and ankles:
        ways = [_way(parents, lengths, tops[0], ankle) for ankle in ankles]
        share = _HEAD_SHARE if heads else _NECK_SHARE
        height = float(np.median(ways)) / share
        if height > 0:
            top = "head" if heads else "neck"
            return height, f"from the bones between {top} and ankles"
    spread = 0.0
    for pose in positions[:: max(1, len(positions) // 20)]:
        spread = max(spread, _spread(pose))
    return spread, "from the largest distance between two joints"


def _spread(places: np.ndarray) -> float:
    """The largest distance between two of `(J, 3)` places; of very many, by going to the farthest from
    the farthest, which falls short of it by little."""
    if len(places) <= _PAIRWISE:
        return float(np.linalg.norm(places[:, None] - places[None], axis=-1).max())
    at, out = places.mean(0), 0.0
    for _ in range(4):
        far = np.linalg.norm(places - at, axis=-1)
        at, out = places[far.argmax()], float(far.max())
    return out


def _way(parents: Sequence[int], lengths: np.ndarray, a: int, b: int) -> float:
    """Length of the bones on the way between two joints."""
    up_a, up_b = line_to_root(parents, a), line_to_root(parents, b)
    shared = set(up_a) & set(up_b)
    return float(sum(lengths[j] for j in (*up_a, *up_b) if j not in shared))


def sampled(frames: int, count: int = 60) -> np.ndarray:
    """Up to `count` frame indices spread over a clip."""
    return np.unique(np.linspace(0, frames - 1, min(frames, count)).astype(int))


def standing_height(clip: Clip) -> tuple[float, str]:
    """The person's standing height in metres, and how it was found."""
    at = sampled(clip.frames)
    part = clip.replaced(root_pos=clip.root_pos[at], rot=clip.rot[at])
    return body_height(
        clip.skeleton.names, clip.skeleton.parents, clip.skeleton.offsets, part.positions()
    )


def describe(clip: Clip) -> dict[str, Any]:
    """The clip's facts: format, joints, fps, frames, seconds, unit_m, up_axis, height_m (m),
    height_from (how the height was found), warnings (all that was guessed or repaired)."""
    height, how = standing_height(clip)
    source = clip.skeleton.source
    return {
        "format": source.format,
        "joints": len(clip.skeleton),
        "fps": clip.fps,
        "frames": clip.frames,
        "seconds": clip.seconds,
        "unit_m": source.unit_m,
        "up_axis": source.up_axis,
        "height_m": height,
        "height_from": how,
        "warnings": list(source.notes),
    }
