"""Gaps between keyframes, and how a network's frames fill one at the clip's own rate, in variants."""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.kinematics.feet import Motion
from poise.kinematics.retargeting.passage import Retargeter
from poise.kinematics.retargeting.standing import ClipWorld
from poise.kinematics.steps import lock_feet, planted, stepped
from poise.learn.between import Between
from poise.learn.inbetween_model import Adaptation, InbetweenModel, adapt
from poise.learn.transition import FilledGap, Known
from poise.learn.transition import FilledGap as Transition
from poise.motion.clip import Clip
from poise.motion.roles import map_joints
from poise.motion.rotations import (
    normalize,
    quat_between,
    quat_mul,
    rotvec_to_quat,
    slerp,
    unwrap_quats,
)
from poise.synthesis.limits import Calmed, Feet, calmed, excess, flown, meet, sampled, spread


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
        raise PoiseError(
            f"in-betweening needs at least 2 keyframes, got {len(keys)}", where, code="too-few-keyframes"
        )
    for k in keys:
        if not 0 <= k < frames:
            raise PoiseError(
                f"keyframe {k} is out of range",
                where,
                f"The clip has frames 0 to {frames - 1}",
                code="frame-outside",
            )
    for a, b in pairwise(keys):
        if a == b:
            raise PoiseError(
                f"keyframe {a} is given twice",
                where,
                "Give every keyframe once",
                code="keyframe-repeated",
            )
        if a > b:
            raise PoiseError(
                f"keyframe {b} comes after {a}",
                where,
                "Give keyframes in rising order",
                code="not-rising",
            )
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


@dataclass(frozen=True, eq=False)
class OtherRig:
    """The passage between a clip's skeleton and a network's. A path is root `(T, 3)` m and rot
    `(T, J, 4)` wxyz local."""

    clip: Clip
    example: Clip
    there: Retargeter
    back: Retargeter

    @staticmethod
    def between(clip: Clip, example: Clip) -> OtherRig:
        """The passage of `clip` to the skeleton of `example`, which also shows how that one stands.

        Raises:
            PoiseError: a skeleton without pelvis or legs.
        """
        there = Retargeter.between(clip, example)
        joints = map_joints(example.skeleton, clip.skeleton)
        back = Retargeter(joints, there.there, there.here, there.scale.inverse())
        return OtherRig(clip, example, there, back)

    def to_model(self, path: Motion) -> Motion:
        """A path of the clip's skeleton on the network's."""
        return self._passed(self.clip, self.there, path)

    def to_clip(self, path: Motion) -> Motion:
        """A path of the network's skeleton on the clip's."""
        return self._passed(self.example, self.back, path)

    def changed(self, known: Motion, filled: Motion) -> Motion:
        """`known` on the clip's skeleton with what makes `filled`, on the network's, differ from it.

        With P the passage there and B the passage back, x B(P(x))^-1 B(f), joint by joint and likewise
        for the root's place: where the network changes nothing, the clip stays to the last digit.
        """
        before, after = self.to_clip(self.to_model(known)), self.to_clip(filled)
        root = known[0] + after[0] - before[0]
        turn = quat_between(before[1], after[1])
        return root, unwrap_quats(normalize(quat_mul(known[1], turn)))

    @staticmethod
    def _passed(clip: Clip, passage: Retargeter, path: Motion) -> Motion:
        rot, root = passage.transfer(ClipWorld(*clip.skeleton.forward(*path)))
        return root, unwrap_quats(normalize(rot))


#: m to the side, radians and share of the gap by which the middle of a variant is elsewhere, turned, and
#: earlier or later, in a gap of a second or more; in shorter ones less, as the square of the time.
ASIDE_M, TURNED, SHIFTED = 0.25, 0.35, 0.2
#: Frames of a gap below which there is no middle to lead through.
_LEAST = 8


class Detour(NamedTuple):
    """What a variant's middle is.

    Attributes:
        frame: of the gap, that it goes through.
        pose: frame of the best guess with the pose that it has there.
        aside: m, across the way.
        turn: radians, about the vertical.
    """

    frame: int
    pose: int
    aside: float
    turn: float


def drawn(length: int, fps: float, noise: torch.Generator) -> Detour | None:
    """A detour for a gap of `length` frames; None where it is too short for one.

    Each is at least half as large as it may be, so that no variant is the best guess again.
    """
    if length < _LEAST:
        return None
    u = torch.rand(4, generator=noise).tolist()
    reach = min(1.0, length / fps) ** 2
    frame = round((0.4 + 0.2 * u[0]) * (length - 1))

    def either(share: float, most: float) -> float:
        """Between half of `most` and all of it, on either side."""
        return math.copysign(most * (0.5 + abs(share - 0.5)), share - 0.5)

    pose = frame + round(either(u[1], SHIFTED * reach) * length)
    return Detour(
        frame,
        min(max(pose, 0), length - 1),
        either(u[2], ASIDE_M * reach),
        either(u[3], TURNED * reach),
    )


def through(
    net: Between,
    root: Tensor,
    rot: Tensor,
    seen: Tensor,
    offsets: Tensor,
    guess: FilledGap,
    detour: Detour,
    noise: torch.Generator,
) -> FilledGap:
    """The frames of one window `(1, T, ...)` again, led through a detour of the best guess.

    Args:
        root, rot, seen, offsets: as `Between.complete` takes them.
        guess: what it made of all T frames.
    """
    first = int((~seen).nonzero()[0])
    last = int((~seen).nonzero()[-1])
    at, pose = first + detour.frame, first + detour.pose
    way = guess.root[:, last] - guess.root[:, first]
    flat = way * torch.tensor([1.0, 1.0, 0.0]).to(way)
    size = flat.norm(dim=-1, keepdim=True)
    # Where the body stays it is displaced along X.
    ahead = torch.where(size > 0.05, flat / size.clamp_min(1e-6), torch.tensor([0.0, -1.0, 0.0]).to(way))
    across = torch.stack((-ahead[:, 1], ahead[:, 0], torch.zeros_like(ahead[:, 0])), -1)
    turn = rotvec_to_quat(torch.tensor([[0.0, 0.0, detour.turn]]).to(way))
    root, rot, seen = root.clone(), rot.clone(), seen.clone()
    # The pose of another time at the place of this one, aside.
    root[:, at] = guess.root[:, at] + detour.aside * across
    root[:, at, 2] = guess.root[:, pose, 2]
    rot[:, at] = guess.rot[:, pose]
    rot[:, at, 0] = quat_mul(turn, guess.rot[:, pose, 0])
    seen[at] = True
    filled = net.complete(root, rot, seen, offsets, noise)
    # What a network says of the feet in known frames was never learned.
    contact = filled.contact.clone()
    contact[:, at] = 0.5 * (contact[:, at - 1] + contact[:, at + 1])
    return filled._replace(contact=contact)


#: Test-time adaptation of one gap, so that its feet slide less: of 10, 20 and 40 iterations at 3e-5 and
#: 1e-4 the one with the least slide, against the recorded, in its worst of four CMU clips (03_01, 03_03,
#: 11_01, 14_14). By the mean of the four 10 iterations at 3e-5 would be as good.
EACH_GAP = Adaptation(iterations=20, lr=1e-4)
#: Seconds over which the ends of a gap are brought to the speed of the kept motion.
BLEND_S = 0.2


@dataclass(frozen=True)
class Filling:
    """How gaps are filled.

    samples: clips to make; the first is the network's best guess, the others are variants.
    foot_lock: hold feet where the network says that they stand. adaptation: test-time adaptation of each
    gap. rounds: how often gaps are filled anew in which the doctor finds faults.
    """

    samples: int = 1
    foot_lock: bool = True
    adaptation: Adaptation | None = None
    seed: int = 0
    rounds: int = 4


def interpolated(own: Clip, root: np.ndarray, rot: np.ndarray, gaps: list[Gap]) -> Clip:
    """The clip with its gaps interpolated: what lies in them is not to be looked at."""
    root, rot = root.copy(), rot.copy()
    for gap in gaps:
        root[gap.a + 1 : gap.b], rot[gap.a + 1 : gap.b] = straight(root, rot, gap)
    return own.replaced(root_pos=root, rot=rot, contacts=())


def straight(root: np.ndarray, rot: np.ndarray, gap: Gap) -> tuple[np.ndarray, np.ndarray]:
    """The frames of a gap on straight lines and shortest arcs between its ends."""
    a, b = gap
    t = np.arange(1, b - a, dtype=root.dtype) / (b - a)
    line = root[a] + t[:, None] * (root[b] - root[a])
    return line, slerp(rot[a], rot[b], t[:, None])


@dataclass(frozen=True, eq=False)
class Filler:
    """Fills the gaps of one clip `own`.

    Attributes:
        feet: its joints that may stand.
        limits: `(J,)` m/s that its joints reach at most.
        aloft: m that each keyframe is off the floor, 0 for those that stand.
        speeds: m/s, the level velocity at those in the air.
        floor: m, heights of ankles and of toes that stand.
        calmed: what each gap was made of to keep to what people reach, by its ends.
        best: the network's best guess of each gap, which filling it anew needs again.
    """

    own: Clip
    model: InbetweenModel
    filling: Filling
    keys: tuple[int, ...]
    rig: OtherRig | None
    feet: Sequence[int]
    limits: np.ndarray
    aloft: dict[int, float]
    speeds: dict[int, np.ndarray] = field(default_factory=dict[int, np.ndarray])
    floor: tuple[float, float] = (0.0, 0.0)
    calmed: dict[Gap, Calmed] = field(default_factory=dict[Gap, Calmed])
    best: dict[Gap, tuple[np.ndarray, np.ndarray, np.ndarray]] = field(
        default_factory=dict[Gap, tuple[np.ndarray, np.ndarray, np.ndarray]]
    )

    @torch.no_grad()
    def fill(
        self,
        root: np.ndarray,
        rot: np.ndarray,
        gap: Gap,
        noise: torch.Generator | None,
        most: float = 1.0,
        ways: tuple[Feet, ...] = ("held", "stepped", "free"),
    ) -> None:
        """Fills a gap in place, with the share `most` of the network's motion at most, and with the
        first of `ways` for its feet that people can do."""
        a, b = gap
        if noise is not None:
            *made, contact = self._transition(root, rot, gap, noise)
        else:
            if gap not in self.best:
                self.best[gap] = self._transition(root, rot, gap, None)
            *made, contact = self.best[gap]
        plain = straight(root, rot, gap)
        ends = (root[[a, b]], rot[[a, b]])
        made = spread(ends, (made[0], made[1]))
        before, after = (self.aloft.get(k, 0.0) for k in gap)
        flight = None
        if max(before, after) > 0.0:
            speeds = self.speeds.get(a), self.speeds.get(b)
            flight = flown(plain[0][:, 2], ends[0][:, :2], before, after, self.own.fps, speeds)
            path = np.concatenate((flight.level, flight.height[:, None]), 1)
            made, plain = (path, made[1]), (path.copy(), plain[1])

        def fast(whole: Motion) -> float:
            return excess(self.own.skeleton, self.limits, whole, self.own.fps)[0]

        def over(motion: Motion) -> float:
            whole = tuple(np.concatenate((e[:1], m, e[1:])) for e, m in zip(ends, motion, strict=True))
            return fast((whole[0], whole[1]))

        def finish(motion: Motion, feet: Feet) -> Motion:
            root[a + 1 : b], rot[a + 1 : b] = motion
            holds = feet == "held" and flight is None
            self._finish(root, rot, gap, contact if holds else contact[:, :0])
            if flight is not None and feet == "held":
                here, off = slice(a, b + 1), (before > 0.0, after > 0.0)
                how = off, flight.lean, flight.falls, self.own.fps
                moved = planted(self.own.skeleton, (root[here], rot[here]), *how)
                root[here], rot[here] = moved
            if feet == "stepped":
                here = slice(a, b + 1)
                past = (root[a - 1 : a], rot[a - 1 : a]) if a else None
                walked = stepped(
                    self.own.skeleton, (root[here], rot[here]), self.floor, past, self.own.fps, fast
                )
                if walked is not None:
                    root[here], rot[here] = walked
                    self._finish(root, rot, gap, contact[:, :0])
            return root[a + 1 : b].copy(), rot[a + 1 : b].copy()

        if flight is not None:
            # Feet that are let go would be under the floor before and after a flight.
            ways = ("held",)
        done = calmed(made, plain, finish, over, ways if self.filling.foot_lock else ("free",), most)
        root[a + 1 : b], rot[a + 1 : b] = done.motion
        self.calmed[gap] = done

    def join(self, root: np.ndarray, rot: np.ndarray, gap: Gap) -> None:
        """Lets the ends of a filled gap meet what lies beside it now, in place."""
        self._finish(root, rot, gap, np.zeros((gap.b - gap.a - 1, 0)))

    def _finish(self, root: np.ndarray, rot: np.ndarray, gap: Gap, contact: np.ndarray) -> None:
        """Holds the feet of a gap and lets its ends meet, in place."""
        a, b = gap
        # Two frames before, and after the gap where they are kept, say how fast it must be met.
        low = max(0, a - 1)
        high = min(len(root), b + 2) if b >= self.keys[-1] else b + 1
        if len(self.feet) and len(self.feet) == contact.shape[1]:
            free = np.zeros(high - low, dtype=bool)
            free[a + 1 - low : b - low] = True
            stands = np.zeros((high - low, contact.shape[1]), dtype=bool)
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
        self, root: np.ndarray, rot: np.ndarray, gap: Gap, noise: torch.Generator | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the network makes of one gap, at the clip's own frames."""
        (a, b), own, model, rig = gap, self.own, self.model, self.rig
        # The gap is cut into whole steps near the model's rate, so that both its ends lie on the grid.
        length = max(1, round((b - a) * model.fps / own.fps) - 1)
        step = (b - a) / (length + 1)
        past = min(model.past, 1 + int(a / step + 1e-6))
        before = sampled(root[: a + 1], rot[: a + 1], a - step * np.arange(past - 1, -1, -1))
        ahead, after = (root[b : b + 1], rot[b : b + 1]), self._after(root, rot, b, step)
        offsets = np.array((own if rig is None else rig.example).skeleton.offsets)
        if rig is not None:
            before, ahead = rig.to_model(before), rig.to_model(ahead)
            after = None if after is None else rig.to_model(after)
        seen = (_seen(x) for x in (*before, ahead[0][0], ahead[1][0], offsets))
        known, net = Known(*seen), model.net
        if self.filling.adaptation is not None:
            net = adapt(net, known, length, self.filling.adaptation)
        if isinstance(net, Between):
            later = None if after is None else (_seen(after[0]), _seen(after[1]))
            filled = _by_transformer(net, known, length, later, noise, model.fps)
        else:
            filled = net.fill(known, length, noise)
        made = (x[0].double().numpy() for x in (filled.root, filled.rot))
        grid_root, grid_rot = map(np.concatenate, zip(before, made, ahead, strict=True))
        at = np.arange(a + 1, b).astype(float)
        new_root, new_rot = sampled(grid_root, grid_rot, past - 1 + (at - a) / step)
        if rig is not None:
            new_root, new_rot = rig.changed(straight(root, rot, gap), (new_root, new_rot))
        nearest = np.clip(np.round((at - a) / step).astype(int), 1, length) - 1
        return new_root, new_rot, filled.contact[0].numpy()[nearest]

    def _after(self, root: np.ndarray, rot: np.ndarray, b: int, step: float) -> Motion | None:
        """Frames after the last keyframe at the model's rate, where the clip has any that are kept."""
        count = min(self.model.past - 1, int((len(root) - 1 - b) / step + 1e-6))
        if b < self.keys[-1] or count < 1:
            return None
        return sampled(root[b:], rot[b:], step * np.arange(1, count + 1))


def _seen(x: np.ndarray) -> Tensor:
    """A network's input, as a batch of one."""
    return torch.tensor(x, dtype=torch.float32)[None]


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
        parts.append(after)
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
