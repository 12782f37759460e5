"""What animators have instead of whole keyframes: poses with rough times, and keyframes of which only
hands, feet or the pelvis are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.kin.directed import LIMBS, PELVIS, TouchPoint, end_of
from poise.motion import Clip
from poise.synth.retime import retimed

#: What words mean.
PARTS = {
    "hands": ("left_hand", "right_hand"), "feet": ("left_foot", "right_foot"), "pelvis": (PELVIS,),
    **{limb: (limb,) for limb in LIMBS},
}  # fmt: skip
EVERYTHING = ("hands", "feet", "pelvis")


@dataclass(frozen=True)
class Partial:
    """A keyframe of which only some parts stay.

    Attributes:
        frame: of the clip, between keyframes.
        parts: hands, feet, pelvis, or single ones such as left_hand.
    """

    frame: int
    parts: tuple[str, ...] = EVERYTHING

    def __post_init__(self) -> None:
        for part in self.parts:
            if part not in PARTS:
                hint = did_you_mean(part, list(PARTS))
                raise PoiseError(f"there is no part '{part}' of a keyframe", hint=hint)

    def touches(self, source: Clip) -> tuple[TouchPoint, ...]:
        """The places of its parts in `source`.

        Raises:
            PoiseError: a frame that the source does not have.
        """
        if not 0 <= self.frame < source.frames:
            what = f"a keyframe of parts is wanted in frame {self.frame}, and the clip has 0 to"
            raise PoiseError(f"{what} {source.frames - 1}", source.name)
        pos = source.positions()[self.frame]
        limbs = dict.fromkeys(limb for part in self.parts for limb in PARTS[part])
        joints = {limb: 0 if limb == PELVIS else end_of(source.skeleton, limb) for limb in limbs}
        return tuple(
            TouchPoint(limb, self.frame, (float(pos[j, 0]), float(pos[j, 1]), float(pos[j, 2])))
            for limb, j in joints.items()
        )


def timed(clip: Clip, keys: Sequence[int], times: Sequence[float]) -> tuple[Clip, tuple[int, ...]]:
    """The clip with its keyframes at `times` (s), and where they are then; times count from the first.

    Raises:
        PoiseError: not one time for each keyframe, or times that do not rise.
    """
    if len(times) != len(keys):
        raise PoiseError(f"{len(keys)} keyframes need as many times, got {len(times)}", clip.name)
    gaps = np.diff(np.asarray(times, dtype=float))
    if not bool((gaps * clip.fps >= 0.5).all()):
        k = int(np.argmin(gaps))
        raise PoiseError(
            f"times must rise by a frame or more, got {times[k]:g} and then {times[k + 1]:g} s",
            clip.name,
        )
    return retimed(clip, keys, gaps * clip.fps / np.diff(np.asarray(keys)))


def moved_to(frame: int, keys: Sequence[int], at: Sequence[int]) -> int:
    """Where a frame is, when keyframes `keys` are at `at`."""
    outside = frame < keys[0] or frame > keys[-1]
    if outside:
        return frame + (at[0] - keys[0] if frame < keys[0] else at[-1] - keys[-1])
    return round(float(np.interp(frame, keys, at)))


def partials_of(words: Sequence[str]) -> tuple[Partial, ...]:
    """What words ask for: "45", "45:hands,pelvis".

    Raises:
        PoiseError: words that make no sense.
    """
    out: list[Partial] = []
    for word in words:
        frame, _, parts = word.partition(":")
        if not frame.isdigit():
            hint = "Write 45:hands,feet,pelvis, a frame and the parts that stay"
            raise PoiseError(f"--partial '{word}' makes no sense", hint=hint)
        out.append(Partial(int(frame), tuple(parts.split(",")) if parts else EVERYTHING))
    return tuple(out)


def times_of(text: str) -> tuple[float, ...]:
    """(0.0, 1.2, 2.0) from "0,1.2,2".

    Raises:
        PoiseError: what is no number.
    """
    try:
        return tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError:
        hint = "Write for example --times 0,1.2,2.5, in s"
        raise PoiseError(f"--times needs numbers, got '{text}'", hint=hint) from None
