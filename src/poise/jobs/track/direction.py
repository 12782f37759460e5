"""A director's controls of tracking: what counts more, what stays put, what is touched, what pushes and
what is held."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from poise.body import BodyTable
from poise.control import Stiffness
from poise.control.compliance import NewtonsPerMetre
from poise.errors import PoiseError, did_you_mean
from poise.jobs.track.pushed import HeldConfig, PushConfig, row_of, way_of
from poise.kinematics.directed import LIMBS, PELVIS, Pin, TouchPoint, check_asked, directed, ease
from poise.motion import Clip
from poise.settings import Range, validate

#: Cost per metre of distance in a control step of a part that counts twice, and of limbs that are
#: pinned or touch.
PRICE, HELD_PRICE = 10.0, 40.0
#: Parts by the names of weights: kinds of the body table.
PARTS = {
    "hands": ("hand",), "feet": ("foot",), "arms": ("upper_arm", "forearm", "hand"),
    "legs": ("thigh", "shin", "foot"), "head": ("neck", "head"), "trunk": ("pelvis", "spine"),
    "root": ("pelvis",), "pelvis": ("pelvis",), "all": (),
}  # fmt: skip
SIDED = ("hand", "foot", "arm", "leg")
HANDS = ("left_hand", "right_hand")
#: Highest weight.
MOST = 100.0


@dataclass(frozen=True)
class Weight:
    """Parts that count more, or less, than the rest.

    Attributes:
        part: one of `PARTS`, with a side for hands, feet, arms and legs: "left_hand"; or a body.
        factor: how much more, 1 as ever.
        first, last: frames of the clip; None is its begin and its end.
    """

    part: str
    factor: Annotated[float, Range(0, MOST)]
    first: int | None = None
    last: int | None = None

    def __post_init__(self) -> None:
        validate(self, self.part)


@dataclass(frozen=True)
class FramePush:
    """A push that begins at a frame.

    Attributes:
        frame: of the clip.
        push: the push; its `start_s` is that of the frame.
    """

    frame: int
    push: PushConfig


@dataclass(frozen=True)
class FrameStiffness:
    """A stiffness that is commanded from a frame on.

    Attributes:
        frame: of the clip.
        newtons_per_metre: see `control.Stiffness`.
    """

    frame: int
    newtons_per_metre: NewtonsPerMetre

    def __post_init__(self) -> None:
        validate(self, "--stiffness")


@dataclass(frozen=True)
class FrameHeld:
    """A thing that a hand holds from one frame to another.

    Attributes:
        first, last: frames of the clip.
        thing: the thing; its time is that of the frames.
    """

    first: int
    last: int
    thing: HeldConfig


@dataclass(frozen=True)
class Direction:
    """What a director wants of a motion.

    Attributes:
        weights: what counts more than the rest; lookahead alone looks at it.
        pins: hands and feet that stay where they are.
        touches: points that hands, feet and the pelvis reach.
        pushes: forces that it is to bear, to which it gives way.
        stiffness: how it gives way to them, each from its frame on and the first one also before; by
            default as the pushes say.
        held: things in its hands.
    """

    weights: tuple[Weight, ...] = ()
    pins: tuple[Pin, ...] = ()
    touches: tuple[TouchPoint, ...] = ()
    pushes: tuple[FramePush, ...] = ()
    stiffness: tuple[FrameStiffness, ...] = ()
    held: tuple[FrameHeld, ...] = ()

    def __bool__(self) -> bool:
        return self.leads or self.forces or bool(self.stiffness)

    @property
    def leads(self) -> bool:
        """Whether it says where something is to be, or what counts more."""
        return bool(self.weights or self.pins or self.touches)

    @property
    def forces(self) -> bool:
        """Whether something pushes, or is held."""
        return bool(self.pushes or self.held)

    def moved(self, to: Callable[[int], int]) -> Direction:
        """The same with every frame where `to` says that it is."""

        def there(frame: int | None) -> int | None:
            return None if frame is None else to(frame)

        return Direction(
            tuple(replace(w, first=there(w.first), last=there(w.last)) for w in self.weights),
            tuple(replace(p, first=to(p.first), last=to(p.last)) for p in self.pins),
            tuple(replace(t, frame=to(t.frame)) for t in self.touches),
            tuple(replace(p, frame=to(p.frame)) for p in self.pushes),
            tuple(replace(s, frame=to(s.frame)) for s in self.stiffness),
            tuple(replace(h, first=to(h.first), last=to(h.last)) for h in self.held),
        )

    def check(self, clip: Clip, table: BodyTable) -> None:
        """Refuses what a clip or a body does not have, before anything is made.

        Raises:
            PoiseError: a frame, a limb or a part that is not there.
        """
        check_asked(clip, (*self.pins, *self.touches))
        for weight in self.weights:
            rows_of(table, weight.part)
            if weight.first is not None and weight.first >= clip.frames:
                what = f"{weight.part} counts from frame {weight.first} on, and the clip has 0 to"
                raise PoiseError(f"{what} {clip.frames - 1}", clip.name, code="frame-outside")
        self._check_forces(clip, table)

    def _check_forces(self, clip: Clip, table: BodyTable) -> None:
        if self.stiffness and not self.pushes:
            raise PoiseError(
                "a commanded stiffness needs something that pushes",
                hint="Add --push FRAME:PART=NEWTONS",
                code="option-needs-option",
            )
        asked = [("the push", p.frame, p.frame) for p in self.pushes]
        asked += [("the stiffness", s.frame, s.frame) for s in self.stiffness]
        asked += [("the held thing", h.first, h.last - 1) for h in self.held]
        for what, first, last in asked:
            if max(first, last) >= clip.frames - 1:
                where = f"from {first} to {last + 1}" if what == "the held thing" else f"at {first}"
                raise PoiseError(
                    f"{what} is {where}, and the clip has the frames 0 to {clip.frames - 1}",
                    clip.name,
                    "It must begin before the last frame and end with it at the latest",
                    code="frame-outside",
                )
        for part in (*(p.push.at for p in self.pushes), *(h.thing.at for h in self.held)):
            row_of(table, part)

    def forces_of(self, fps: float) -> tuple[tuple[PushConfig, ...], tuple[HeldConfig, ...]]:
        """Pushes and held things at their times, for a clip of so many frames a second."""
        pushes = tuple(replace(p.push, start_s=p.frame / fps) for p in self.pushes)
        held = tuple(
            replace(h.thing, start_s=h.first / fps, seconds=(h.last - h.first) / fps) for h in self.held
        )
        return pushes, held

    def yields(self, fps: float, rate_hz: float) -> Stiffness | None:
        """How the goal gives way, by control steps; None where no stiffness is stated."""
        if not self.stiffness:
            return None
        rising = sorted(self.stiffness, key=lambda s: s.frame)
        steps = [max(1, round(s.frame / fps * rate_hz)) for s in rising[1:]]
        later = tuple((k, s.newtons_per_metre) for k, s in zip(steps, rising[1:], strict=True))
        return Stiffness(rising[0].newtons_per_metre, schedule=later)

    def applied(self, clip: Clip) -> tuple[Clip, tuple[str, ...]]:
        """The clip with its pins and touches, and sentences on them."""
        return directed(clip, self.pins, self.touches)

    def prices(self, clip: Clip, table: BodyTable, frames: int, rate_hz: float) -> Tensor | None:
        """`(frames, B)`, what a metre of distance costs in each control step beside the reward; None
        where nothing counts more.

        Raises:
            PoiseError: a part that the body does not have.
        """
        if not self.leads:
            return None
        out = torch.zeros(frames, len(table.rows))
        at = torch.arange(frames) / rate_hz * clip.fps
        for weight in self.weights:
            first = 0 if weight.first is None else weight.first
            last = clip.frames - 1 if weight.last is None else weight.last
            # A single frame counts in the control step nearest to it.
            half = 0.5 * max(1.0, clip.fps / rate_hz)
            inside = (at >= first - half) & (at <= last + half)
            rows = rows_of(table, weight.part)
            price = PRICE * (weight.factor - 1.0) / len(rows)
            out[inside[:, None] & torch.tensor([i in rows for i in range(len(table.rows))])] += price
        for held in (*self.pins, *self.touches):
            span = (held.first, held.last) if isinstance(held, Pin) else (held.frame, held.frame)
            share = torch.tensor(ease(clip.frames, *span, clip.fps))
            share = share[at.round().long().clamp_max(clip.frames - 1)]
            for row in rows_of(table, held.limb):
                out[:, row] += HELD_PRICE * share.float() ** 4
        return out


def rows_of(table: BodyTable, part: str) -> tuple[int, ...]:
    """Rows of a body table that a part's name means.

    Raises:
        PoiseError: no such part.
    """
    side, _, name = part.rpartition("_")
    plural = {"hand": "hands", "foot": "feet", "arm": "arms", "leg": "legs"}
    if side in ("left", "right") and name in plural:
        kinds = PARTS[plural[name]]
        return tuple(i for i, r in enumerate(table.rows) if r.kind in kinds and r.side == side)
    if part == "all":
        return tuple(range(len(table.rows)))
    if part in PARTS:
        return tuple(i for i, r in enumerate(table.rows) if r.kind in PARTS[part])
    found = tuple(i for i, r in enumerate(table.rows) if r.name == part)
    if not found:
        known = [*PARTS, *LIMBS, *(f"{s}_{n}" for s in ("left", "right") for n in ("arm", "leg"))]
        raise PoiseError(
            f"there is no part '{part}'",
            hint=did_you_mean(part, [*known, *(r.name for r in table.rows)]),
            code="unknown-body-part",
        )
    return found


def direction_of(
    weights: Sequence[str] = (),
    pins: Sequence[str] = (),
    touches: Sequence[str] = (),
    pushes: Sequence[str] = (),
    stiffness: Sequence[str] = (),
    held: Sequence[str] = (),
) -> Direction:
    """The direction in words: "hands=3", "head=2:10-40"; "left_foot:12-40"; "right_hand:50:0.3,0.2,1.1";
    "30:hand=150", "30:chest=200:0.3:0,1,0"; "30=200"; "30-60:right_hand=2.5:0.3".

    Raises:
        PoiseError: words that make no sense.
    """
    return Direction(
        tuple(_weight(w) for w in weights),
        tuple(_pin(w) for w in pins),
        tuple(_touch(w) for w in touches),
        tuple(_push(w) for w in pushes),
        tuple(_stiffness(w) for w in stiffness),
        tuple(_held(w) for w in held),
    )


def _push(word: str) -> FramePush:
    try:
        frame, what, *rest = word.split(":")
        part, newtons = what.split("=")
        if len(rest) > 2 or int(frame) < 0:
            raise ValueError
        seconds = float(rest[0]) if rest else PushConfig.seconds
        way = way_of(rest[1], f"the direction of --push '{word}'") if len(rest) > 1 else None
        push = PushConfig(float(newtons), part, seconds=seconds, direction=way)
        return FramePush(int(frame), push)
    except ValueError:
        raise PoiseError(
            f"--push '{word}' makes no sense",
            hint="Write 30:hand=150, or 30:hand=150:0.5:0,1,0 with how long in s and where to",
            code="option-malformed",
        ) from None


def _stiffness(word: str) -> FrameStiffness:
    try:
        frame, value = word.split("=")
        if int(frame) < 0:
            raise ValueError
        return FrameStiffness(int(frame), float(value))
    except ValueError:
        raise PoiseError(
            f"--stiffness '{word}' makes no sense",
            hint="Write 30=200, a frame and N/m",
            code="option-malformed",
        ) from None


def _held(word: str) -> FrameHeld:
    try:
        span, what, *rest = word.split(":")
        limb, kg = what.split("=")
        if len(rest) > 1:
            raise ValueError
        size = float(rest[0]) if rest else HeldConfig.size_m
        first, last = _span(span)
        if first == last:
            raise ValueError
        if limb not in HANDS:
            raise PoiseError(
                f"a thing is held by a hand, got '{limb}'",
                hint=did_you_mean(limb, HANDS),
                code="unknown-limb",
            )
        return FrameHeld(first, last, HeldConfig(limb, float(kg), size))
    except ValueError:
        raise PoiseError(
            f"--held '{word}' makes no sense",
            hint="Write 30-60:right_hand=2.5, or 30-60:right_hand=2.5:0.3 with its size in m",
            code="option-malformed",
        ) from None


def _weight(word: str) -> Weight:
    try:
        part, _, rest = word.partition("=")
        factor, _, span = rest.partition(":")
        first, last = _span(span) if span else (None, None)
        return Weight(part, float(factor), first, last)
    except ValueError:
        raise PoiseError(
            f"--weight '{word}' makes no sense",
            hint="Write hands=3 or head=2:10-40",
            code="option-malformed",
        ) from None


def _pin(word: str) -> Pin:
    try:
        limb, span = word.split(":")
        return Pin(_limb(limb), *_span(span))
    except ValueError:
        raise PoiseError(
            f"--pin '{word}' makes no sense", hint="Write left_foot:12-40", code="option-malformed"
        ) from None


def _touch(word: str) -> TouchPoint:
    try:
        limb, frame, place = word.split(":")
        x, y, z = (float(v) for v in place.split(","))
        return TouchPoint(limb if limb == PELVIS else _limb(limb), int(frame), (x, y, z))
    except ValueError:
        hint = "Write right_hand:50:0.3,0.2,1.1, a limb, a frame and a place in m"
        raise PoiseError(
            f"--touch '{word}' makes no sense", hint=hint, code="option-malformed"
        ) from None


def _limb(name: str) -> str:
    if name not in LIMBS:
        raise PoiseError(
            f"there is no limb '{name}'", hint=did_you_mean(name, list(LIMBS)), code="unknown-limb"
        )
    return name


def _span(text: str) -> tuple[int, int]:
    first, last = (int(v) for v in text.split("-"))
    if not 0 <= first <= last:
        raise PoiseError(f"frames must rise from 0, got {text}", code="not-rising")
    return first, last
