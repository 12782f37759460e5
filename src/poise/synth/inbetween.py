"""Fills the frames between keyframes of a clip with a trained network, at the clip's own rate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.model import InbetweenModel
from poise.motion.clip import Clip
from poise.motion.pack import unpack_clips
from poise.motion.windows import foot_joints, still_root, without_still_root
from poise.spatial import slerp
from poise.synth.filler import EACH_GAP, Filler, Filling, interpolated
from poise.synth.flight import flight_speeds
from poise.synth.gaps import Gap, check_keyframes, split_gaps
from poise.synth.limits import (
    ALOFT_M,
    Calmed,
    fastest,
    off_floor,
    standing_heights,
    under_floor,
)
from poise.synth.other_rig import OtherRig
from poise.synth.rounds import best_of_rounds
from poise.synth.verdict import GapFault
from poise.synth.verdict import told as named

__all__ = ["EACH_GAP", "Filled", "Filling", "fill_keyframes", "interpolated", "unlike"]

#: Bones with directions that differ by more than this (mean over joints, cosine) are of another rig.
_SAME_RIG = 0.94


@dataclass(frozen=True, eq=False)
class Filled:
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
) -> Filled:
    """The clip with everything between its keyframes made anew; all other frames stay as they are.

    Frames before the first keyframe are what the network sees of the past, frames after the last one
    are reached in their own speed. Keyframes themselves stay exactly as they are. A clip of another
    human skeleton is filled on the model's and brought back (see `synth.other_rig`).

    Args:
        on_gap: called after each gap with how many are made and how many there are, all samples counted.

    Raises:
        PoiseError: keyframes that make no sense, or a skeleton that cannot be brought onto the model's.
    """
    filling = filling or Filling()
    if not 1 <= filling.samples <= 1000:
        raise PoiseError(f"the number of samples must be 1 to 1000, got {filling.samples}")
    keys = check_keyframes(keyframes, clip.frames, clip.name)
    other = unlike(clip, model)
    step = clip.fps / model.fps
    gaps, inserted, warnings = split_gaps(keys, (model.longest + 1) * step - 1)
    if not gaps:
        warnings.append("There is nothing to fill between these keyframes: the clip stays as it is")
    own = without_still_root(clip)
    root, rot = own.tensors()
    for k in inserted:
        a, b = max(x for x in keys if x < k), min(x for x in keys if x > k)
        t = torch.tensor((k - a) / (b - a), dtype=root.dtype)
        root[k] = root[a] + t * (root[b] - root[a])
        rot[k] = slerp(rot[a], rot[b], t.expand(rot.shape[1]))
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
    return Filled(tuple(clips), (*warnings, *_calmings(filler.calmed)), gaps_over, tuple(faults))


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
    raise PoiseError(other, clip.name, hint)


def _as_clip(clip: Clip, root: Tensor, rot: Tensor, name: str) -> Clip:
    """The result on the clip's own skeleton, a still root included."""
    turned = rot.numpy()
    if still_root(clip):
        turned = np.concatenate((np.array(clip.rot[:, :1]), turned), 1)
    return clip.replaced(root_pos=root.numpy(), rot=turned, name=name, cyclic=False, contacts=())
