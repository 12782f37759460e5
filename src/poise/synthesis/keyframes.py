"""Fills the frames between keyframes of a clip, whole or partly known, at times that may move."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.formats.own import unpack_clips
from poise.kinematics.directed import LIMBS, PELVIS, TouchPoint, end_of
from poise.kinematics.feet import off_floor, standing_heights, under_floor
from poise.learn.inbetween_model import InbetweenModel
from poise.motion import Clip
from poise.motion.rotations import slerp
from poise.synthesis.filler import (
    Filler,
    Filling,
    Gap,
    OtherRig,
    check_keyframes,
    interpolated,
    split_gaps,
)
from poise.synthesis.limits import ALOFT_M, Calmed, fastest, flight_speeds, sampled
from poise.synthesis.rounds import GapFault, best_of_rounds
from poise.synthesis.rounds import told as named
from poise.synthesis.windows import foot_joints, still_root, without_still_root

#: Bones with directions that differ by more than this (mean over joints, cosine) are of another rig.
_SAME_RIG = 0.94


@dataclass(frozen=True, eq=False)
class FilledClips:
    """The clips, and what the user should know.

    over: by which factor the fastest joint goes beyond what people reach in each gap between keyframes
    of the last clip, 1 at most where none does. faults: what the doctor finds in the gaps of each clip
    after all that was tried.
    """

    clips: tuple[Clip, ...]
    warnings: tuple[str, ...]
    over: tuple[float, ...] = ()
    faults: tuple[GapFault, ...] = ()


def fill_keyframes(
    clip: Clip,
    keyframes: Sequence[int],
    model: InbetweenModel,
    filling: Filling | None = None,
    on_gap: Callable[[int, int], None] | None = None,
) -> FilledClips:
    """The clip with everything between its keyframes made anew; all other frames stay as they are.

    Frames before the first keyframe are what the network sees of the past, frames after the last one
    are reached in their own speed. Keyframes themselves stay exactly as they are. A clip of another
    human skeleton is filled on the model's and brought back (see `synthesis.filler`).

    Args:
        on_gap: called after each gap with how many are made and how many there are, all samples counted.

    Raises:
        PoiseError: keyframes that make no sense, or a skeleton that cannot be brought onto the model's.
    """
    filling = filling or Filling()
    if not 1 <= filling.samples <= 1000:
        raise PoiseError(
            f"the number of samples must be 1 to 1000, got {filling.samples}", code="out-of-range"
        )
    keys = check_keyframes(keyframes, clip.frames, clip.name)
    other = unlike(clip, model)
    step = clip.fps / model.fps
    gaps, inserted, warnings = split_gaps(keys, (model.longest + 1) * step - 1)
    if not gaps:
        warnings.append("There is nothing to fill between these keyframes: the clip stays as it is")
    own = without_still_root(clip)
    root, rot = own.arrays()
    for k in inserted:
        a, b = max(x for x in keys if x < k), min(x for x in keys if x > k)
        t = (k - a) / (b - a)
        root[k] = root[a] + t * (root[b] - root[a])
        rot[k] = slerp(rot[a], rot[b], t)
    rig, feet = None, model.layout.feet
    if other is not None:
        rig = OtherRig.between(interpolated(own, root, rot, gaps), _example(other, clip, model))
        feet = foot_joints(own.skeleton)
        warnings = [f"{other}: gaps are made on the model's skeleton and brought back", *warnings]
    kept = [k for k in range(clip.frames) if k in keys or not keys[0] < k < keys[-1]]
    heights = off_floor(own.skeleton, (root[kept], rot[kept]))
    deep = under_floor(own.skeleton, (root[list(keys)], rot[list(keys)]))
    warnings += [
        f"keyframe {k} lies {float(d):.2f} m under the floor, where no body can be"
        for k, d in zip(keys, deep, strict=True)
        if float(d) > 0.0
    ]
    aloft = {k: float(h) for k, h in zip(kept, heights, strict=True) if k in keys and h > ALOFT_M}
    speeds = flight_speeds(root[:, :2], keys, aloft, own.fps)
    floor = standing_heights(own.skeleton, (root[kept], rot[kept]))
    limits = fastest(own.skeleton)
    filler = Filler(own, model, filling, keys, rig, feet, limits, aloft, speeds, floor)
    clips: list[Clip] = []
    faults: list[GapFault] = []
    for sample in range(filling.samples):
        told = None
        if on_gap is not None:
            told = partial(_counted, on_gap, sample * len(gaps), filling.samples * len(gaps))
        root_, rot_, found = best_of_rounds(filler, (root, rot), gaps, sample, told)
        name = clip.name if filling.samples == 1 else f"{clip.name}-{sample}"
        clips.append(_as_clip(clip, root_, rot_, name))
        faults += found
    for k in sorted({f.sample for f in faults}):
        at = f"sample {k}: " if filling.samples > 1 else ""
        warnings.append(at + named([f for f in faults if f.sample == k]))
    gaps_over = tuple(
        max((c.over for (x, y), c in filler.calmed.items() if a <= x and y <= b), default=0.0)
        for a, b in pairwise(keys)
    )
    return FilledClips(tuple(clips), (*warnings, *_calmings(filler.calmed)), gaps_over, tuple(faults))


def _counted(on_gap: Callable[[int, int], None], before: int, of: int, made: int) -> None:
    on_gap(before + made, of)


def _calmings(calmed: dict[Gap, Calmed]) -> tuple[str, ...]:
    """Which gaps hold less than the whole of what the network made, or are too fast all the same."""

    def listed(gaps: list[str]) -> str:
        return ", ".join(gaps[:6]) + (f" and {len(gaps) - 6} more" if len(gaps) > 6 else "")

    less = [f"{a} to {b} ({100 * c.share:.0f} %)" for (a, b), c in calmed.items() if c.share < 1.0]
    free = [f"{a} to {b}" for (a, b), c in calmed.items() if c.feet == "free"]
    fast = [f"{a} to {b} ({c.over:.1f} x)" for (a, b), c in calmed.items() if c.over > 1.0]
    out: list[str] = []
    if less:
        out.append(
            "all of the network's motion would be too fast for people or have faults; so much of it is "
            f"kept, the rest interpolated: frames {listed(less)}"
        )
    if free and len(free) < len(calmed):
        out.append(f"feet are not held where they could not get there in time: frames {listed(free)}")
    if fast:
        out.append(
            f"the keyframes ask for more than people reach, give them more time: frames {listed(fast)}"
        )
    return tuple(out)


def unlike(clip: Clip, model: InbetweenModel) -> str | None:
    """In what a clip's skeleton differs from the model's, as the first part of a sentence; None if not:
    the same joints, with rest directions that agree."""
    own = without_still_root(clip).skeleton
    if own.names != model.names or own.parents != model.layout.parents:
        here = [n for n in own.names if n not in model.names]
        more = f" ('{here[0]}' is unknown to the model)" if here else ""
        return f"its skeleton has {len(own)} joints that are not the model's {len(model.names)}{more}"
    a, b = np.array(own.offsets[1:]), model.offsets.double().numpy()[1:]
    sizes = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    alike = (a * b).sum(-1)[sizes > 1e-9] / sizes[sizes > 1e-9]
    if len(alike) and alike.mean() < _SAME_RIG:
        return "its joints have the model's names but another rest pose"
    return None


def _example(other: str, clip: Clip, model: InbetweenModel) -> Clip:
    """The model's skeleton as it stands; a model without one knows no other skeletons."""
    if model.example is not None:
        return unpack_clips(*model.example)[0]
    hint = "Retarget the clip to the model's skeleton, or train a model on clips of this one"
    raise PoiseError(other, clip.name, hint, code="skeleton-differs")


def _as_clip(clip: Clip, root: np.ndarray, rot: np.ndarray, name: str) -> Clip:
    """The result on the clip's own skeleton, a still root included."""
    turned = rot
    if still_root(clip):
        turned = np.concatenate((np.array(clip.rot[:, :1]), turned), 1)
    return clip.replaced(root_pos=root, rot=turned, name=name, cyclic=False, contacts=())


@dataclass(frozen=True)
class Retiming:
    """What was done to the times of keyframes.

    Attributes:
        keys: frames of the clip that came in.
        at: frames at which they are now.
        fps: frames a second of both.
        factors: by which each gap is longer.
        called: frames of the file that they are, where times were stated; otherwise `keys`.
    """

    keys: tuple[int, ...]
    at: tuple[int, ...]
    fps: float
    factors: tuple[float, ...]
    called: tuple[int, ...] = ()

    def sentence(self) -> str:
        """The new times in words."""
        changed = [
            f"frame {name} is at {a / self.fps:.2f} s instead of {k / self.fps:.2f} s"
            for name, k, a in zip(self.called or self.keys, self.keys, self.at, strict=True)
            if a != k
        ]
        more = f", and {len(changed) - 6} more" if len(changed) > 6 else ""
        return f"Times were stretched where no body is that fast: {', '.join(changed[:6])}{more}."


def retimed(
    clip: Clip, keys: Sequence[int], factors: Sequence[float] | np.ndarray
) -> tuple[Clip, tuple[int, ...]]:
    """The clip with each gap between keyframes `factors[i]` as long, and where the keyframes are then.

    Keyframes and frames outside of them stay what they are; what is between is sampled.
    """
    if all(f == 1.0 for f in factors):
        return clip, tuple(keys)
    at = [keys[0]]
    for a, b, factor in zip(keys[:-1], keys[1:], factors, strict=True):
        at.append(at[-1] + max(1, round((b - a) * float(factor))))
    places = [np.arange(keys[0], dtype=float)]
    for (a, b), (x, y) in zip(pairwise(keys), pairwise(at), strict=True):
        places.append(a + (b - a) * np.arange(y - x) / (y - x))
    places.append(np.arange(keys[-1], clip.frames, dtype=float))
    root, rot = clip.arrays()
    new = sampled(root, rot, np.concatenate(places))
    return clip.replaced(root_pos=new[0], rot=new[1], cyclic=False, contacts=()), tuple(at)


#: What words mean.
PARTS = {
    "hands": ("left_hand", "right_hand"),
    "feet": ("left_foot", "right_foot"),
    "pelvis": (PELVIS,),
    **{limb: (limb,) for limb in LIMBS},
}
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
                raise PoiseError(
                    f"there is no part '{part}' of a keyframe", hint=hint, code="unknown-body-part"
                )

    def touches(self, source: Clip) -> tuple[TouchPoint, ...]:
        """The places of its parts in `source`.

        Raises:
            PoiseError: a frame that the source does not have.
        """
        if not 0 <= self.frame < source.frames:
            what = f"a keyframe of parts is wanted in frame {self.frame}, and the clip has 0 to"
            raise PoiseError(f"{what} {source.frames - 1}", source.name, code="frame-outside")
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
        raise PoiseError(
            f"{len(keys)} keyframes need as many times, got {len(times)}",
            clip.name,
            code="count-differs",
        )
    gaps = np.diff(np.asarray(times, dtype=float))
    if not bool((gaps * clip.fps >= 0.5).all()):
        k = int(np.argmin(gaps))
        raise PoiseError(
            f"times must rise by a frame or more, got {times[k]:g} and then {times[k + 1]:g} s",
            clip.name,
            code="not-rising",
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
            raise PoiseError(f"--partial '{word}' makes no sense", hint=hint, code="option-malformed")
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
        raise PoiseError(
            f"--times needs numbers, got '{text}'", hint=hint, code="option-malformed"
        ) from None
