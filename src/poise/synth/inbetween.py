"""Fills the frames between keyframes of a clip with a trained network, at the clip's own rate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.adapt import Adaptation, adapt
from poise.learn.model import InbetweenModel
from poise.motion.clip import Clip
from poise.motion.pack import unpack_clips
from poise.motion.windows import foot_joints, still_root, without_still_root
from poise.nets.between import Between
from poise.nets.transition import Filled as Transition
from poise.nets.transition import Known
from poise.spatial import slerp
from poise.synth.footlock import lock_feet
from poise.synth.gaps import Gap, check_keyframes, split_gaps
from poise.synth.limits import (
    ALOFT_M,
    Calmed,
    Motion,
    calmed,
    excess,
    fastest,
    flown,
    off_floor,
    under_floor,
)
from poise.synth.other_rig import OtherRig
from poise.synth.planted import planted
from poise.synth.seams import meet, sampled, spread
from poise.synth.variants import drawn, through

#: Test-time adaptation of one gap, so that its feet slide less: of 10, 20 and 40 iterations at 3e-5 and
#: 1e-4 the one with the least slide, against the recorded, in its worst of four CMU clips (03_01, 03_03,
#: 11_01, 14_14). By the mean of the four 10 iterations at 3e-5 would be as good.
EACH_GAP = Adaptation(iterations=20, lr=1e-4)
#: Seconds over which the ends of a gap are brought to the speed of the kept motion.
BLEND_S = 0.2
#: Bones with directions that differ by more than this (mean over joints, cosine) are of another rig.
_SAME_RIG = 0.94


@dataclass(frozen=True)
class Filling:
    """How gaps are filled.

    samples: clips to make; the first is the network's best guess, the others are variants.
    foot_lock: hold feet where the network says that they stand. adaptation: test-time adaptation of each
    gap.
    """

    samples: int = 1
    foot_lock: bool = True
    adaptation: Adaptation | None = None
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Filled:
    """The clips, and what the user should know.

    over: by which factor the fastest joint goes beyond what people reach in each gap between keyframes
    of the last clip, 1 at most where none does.
    """

    clips: tuple[Clip, ...]
    warnings: tuple[str, ...]
    over: tuple[float, ...] = ()


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
    filler = _Filler(own, model, filling, keys, rig, feet, fastest(own.skeleton), aloft)
    clips: list[Clip] = []
    made = 0
    for sample in range(filling.samples):
        noise = None
        if sample:
            noise = torch.Generator().manual_seed(filling.seed * 100_003 + sample)
        path = root.clone(), rot.clone()
        for gap in gaps:
            filler.fill(*path, gap, noise)
            made += 1
            if on_gap is not None:
                on_gap(made, len(gaps) * filling.samples)
        name = clip.name if filling.samples == 1 else f"{clip.name}-{sample}"
        clips.append(_as_clip(clip, *path, name))
    gaps_over = tuple(
        max((c.over for (x, y), c in filler.calmed.items() if a <= x and y <= b), default=0.0)
        for a, b in pairwise(keys)
    )
    return Filled(tuple(clips), (*warnings, *_calmings(filler.calmed)), gaps_over)


def _calmings(calmed: dict[Gap, Calmed]) -> tuple[str, ...]:
    """Which gaps hold less than the whole of what the network made, or are too fast all the same."""

    def listed(gaps: list[str]) -> str:
        return ", ".join(gaps[:6]) + (f" and {len(gaps) - 6} more" if len(gaps) > 6 else "")

    less = [f"{a} to {b} ({100 * c.share:.0f} %)" for (a, b), c in calmed.items() if c.share < 1.0]
    free = [f"{a} to {b}" for (a, b), c in calmed.items() if not c.held]
    fast = [f"{a} to {b} ({c.over:.1f} x)" for (a, b), c in calmed.items() if c.over > 1.0]
    out: list[str] = []
    if less:
        out.append(
            "the network moves joints faster than people do; so much of its motion is kept, the rest "
            f"interpolated: frames {listed(less)}"
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


def interpolated(own: Clip, root: Tensor, rot: Tensor, gaps: list[Gap]) -> Clip:
    """The clip with its gaps interpolated: what lies in them is not to be looked at."""
    root, rot = root.clone(), rot.clone()
    for gap in gaps:
        root[gap.a + 1 : gap.b], rot[gap.a + 1 : gap.b] = _between(root, rot, gap)
    return own.replaced(root_pos=root.numpy(), rot=rot.numpy())


def _between(root: Tensor, rot: Tensor, gap: Gap) -> tuple[Tensor, Tensor]:
    """The frames of a gap on straight lines and shortest arcs between its ends."""
    a, b = gap
    t = torch.arange(1, b - a, dtype=root.dtype) / (b - a)
    line = root[a] + t[:, None] * (root[b] - root[a])
    shape = (len(t), *rot.shape[1:])
    return line, slerp(rot[a].expand(shape), rot[b].expand(shape), t[:, None].expand(shape[:2]))


@dataclass(frozen=True, eq=False)
class _Filler:
    """Fills the gaps of one clip `own`.

    Attributes:
        feet: its joints that may stand.
        limits: `(J,)` m/s that its joints reach at most.
        aloft: m that each keyframe is off the floor, 0 for those that stand.
        calmed: what each gap was made of to keep to what people reach, by its ends.
    """

    own: Clip
    model: InbetweenModel
    filling: Filling
    keys: tuple[int, ...]
    rig: OtherRig | None
    feet: Sequence[int]
    limits: Tensor
    aloft: dict[int, float]
    calmed: dict[Gap, Calmed] = field(default_factory=dict[Gap, Calmed])

    @torch.no_grad()
    def fill(self, root: Tensor, rot: Tensor, gap: Gap, noise: torch.Generator | None) -> None:
        """Fills a gap in place."""
        a, b = gap
        *made, contact = self._transition(root, rot, gap, noise)
        plain = _between(root, rot, gap)
        ends = (root[[a, b]], rot[[a, b]])
        made = spread(ends, (made[0], made[1]))
        before, after = (self.aloft.get(k, 0.0) for k in gap)
        in_air = torch.zeros(b - a + 1, dtype=torch.bool)
        if jumps := max(before, after) > 0.0:
            flight = flown(plain[0][:, 2], before, after, self.own.fps)
            here, there = ends[0][:, None, :2].to(made[0]).unbind(0)
            level = torch.lerp(here, there, flight.along[:, None])
            path = torch.cat((level, flight.height[:, None]), 1)
            made, plain = (path, made[1]), (path.clone(), plain[1])
            in_air[0], in_air[1:-1], in_air[-1] = before > 0.0, flight.in_air, after > 0.0

        def finish(motion: Motion, hold: bool) -> Motion:
            root[a + 1 : b], rot[a + 1 : b] = motion
            self._finish(root, rot, gap, contact[:, :0] if jumps or not hold else contact)
            if jumps and hold:
                here = slice(a, b + 1)
                rot[here] = planted(self.own.skeleton, root[here], rot[here], in_air, self.own.fps)
            return root[a + 1 : b].clone(), rot[a + 1 : b].clone()

        def over(motion: Motion) -> float:
            whole = tuple(torch.cat((e[:1], m, e[1:])) for e, m in zip(ends, motion, strict=True))
            return excess(self.own.skeleton, self.limits, (whole[0], whole[1]), self.own.fps)[0]

        done = calmed(made, plain, finish, over, self.filling.foot_lock)
        root[a + 1 : b], rot[a + 1 : b] = done.motion
        self.calmed[gap] = done

    def _finish(self, root: Tensor, rot: Tensor, gap: Gap, contact: Tensor) -> None:
        """Holds the feet of a gap and lets its ends meet, in place."""
        a, b = gap
        # Two frames before, and after the gap where they are kept, say how fast it must be met.
        low = max(0, a - 1)
        high = min(len(root), b + 2) if b >= self.keys[-1] else b + 1
        if len(self.feet) and len(self.feet) == contact.shape[1]:
            free = torch.zeros(high - low, dtype=torch.bool)
            free[a + 1 - low : b - low] = True
            stands = torch.zeros(high - low, contact.shape[1], dtype=torch.bool)
            stands[a + 1 - low : b - low] = contact > 0.5
            # A keyframe next to a standing foot is where that foot stands.
            stands[a - low], stands[b - low] = stands[a + 1 - low], stands[b - 1 - low]
            rot[low:high] = lock_feet(
                self.own.skeleton, self.feet, root[low:high], rot[low:high], stands, free, self.own.fps
            )
        blend = max(1, round(BLEND_S * self.own.fps))
        met = meet(root[low:high], rot[low:high], a + 1 - low, high - b, blend)
        root[a + 1 : b], rot[a + 1 : b] = (x[a + 1 - low : b - low] for x in met)

    def _transition(
        self, root: Tensor, rot: Tensor, gap: Gap, noise: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What the network makes of one gap, at the clip's own frames."""
        (a, b), own, model, rig = gap, self.own, self.model, self.rig
        # The gap is cut into whole steps near the model's rate, so that both its ends lie on the grid.
        length = max(1, round((b - a) * model.fps / own.fps) - 1)
        step = (b - a) / (length + 1)
        past = min(model.past, 1 + int(a / step + 1e-6))
        before = sampled(root[: a + 1], rot[: a + 1], a - step * torch.arange(past - 1, -1, -1).double())
        ahead, after = (root[b : b + 1], rot[b : b + 1]), self._after(root, rot, b, step)
        offsets = torch.tensor(np.array((own if rig is None else rig.example).skeleton.offsets))
        if rig is not None:
            before, ahead = rig.to_model(before), rig.to_model(ahead)
            after = None if after is None else rig.to_model(after)
        seen = (x.unsqueeze(0).float() for x in (*before, ahead[0][0], ahead[1][0], offsets))
        known, net = Known(*seen), model.net
        if self.filling.adaptation is not None:
            net = adapt(net, known, length, self.filling.adaptation)
        if isinstance(net, Between):
            filled = _by_transformer(net, known, length, after, noise, model.fps)
        else:
            filled = net.fill(known, length, noise)
        grid_root = torch.cat((before[0], filled.root[0].double(), ahead[0]))
        grid_rot = torch.cat((before[1], filled.rot[0].double(), ahead[1]))
        at = torch.arange(a + 1, b).double()
        new_root, new_rot = sampled(grid_root, grid_rot, past - 1 + (at - a) / step)
        if rig is not None:
            new_root, new_rot = rig.changed(_between(root, rot, gap), (new_root, new_rot))
        nearest = ((at - a) / step).round().long().clamp(1, length) - 1
        return new_root, new_rot, filled.contact[0][nearest]

    def _after(self, root: Tensor, rot: Tensor, b: int, step: float) -> tuple[Tensor, Tensor] | None:
        """Frames after the last keyframe at the model's rate, where the clip has any that are kept."""
        count = min(self.model.past - 1, int((len(root) - 1 - b) / step + 1e-6))
        if b < self.keys[-1] or count < 1:
            return None
        return sampled(root[b:], rot[b:], step * torch.arange(1, count + 1).double())


def _by_transformer(
    net: Between, known: Known, length: int, after: tuple[Tensor, Tensor] | None,
    noise: torch.Generator | None, fps: float,
) -> Transition:  # fmt: skip
    """A transition that also sees what comes `after` the keyframe it leads to, or a variant of it."""
    past = known.past_root.shape[1]
    target = known.target_rot[:, None]
    parts = [
        (known.past_root, known.past_rot),
        (known.target_root.new_zeros(1, length, 3), target.expand(1, length, -1, -1)),
        (known.target_root[:, None], target),
    ]
    if after is not None:
        parts.append((after[0].unsqueeze(0).float(), after[1].unsqueeze(0).float()))
    root, rot = (torch.cat(x, 1) for x in zip(*parts, strict=True))
    seen = torch.ones(root.shape[1], dtype=torch.bool)
    seen[past : past + length] = False
    detour = None if noise is None else drawn(length, fps, noise)
    if detour is None or noise is None:
        filled = net.complete(root, rot, seen, known.offsets, noise)
    else:
        guess = net.complete(root, rot, seen, known.offsets)
        filled = through(net, root, rot, seen, known.offsets, guess, detour, noise)
    return Transition(*(v[:, past : past + length] for v in filled))


def _as_clip(clip: Clip, root: Tensor, rot: Tensor, name: str) -> Clip:
    """The result on the clip's own skeleton, a still root included."""
    turned = rot.numpy()
    if still_root(clip):
        turned = np.concatenate((np.array(clip.rot[:, :1]), turned), 1)
    return clip.replaced(root_pos=root.numpy(), rot=turned, name=name, cyclic=False)
