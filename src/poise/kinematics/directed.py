"""A director's hand on a motion: hands and feet that stay where they are, or reach a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.body import find_anatomy
from poise.errors import PoiseError, did_you_mean
from poise.kinematics.limbs import match_positions
from poise.motion import Clip, Skeleton
from poise.motion.rotations import normalize, quat_conj, quat_mul, slerp
from poise.motion.smoothing import gaussian_sums, smoothstep
from poise.motion.vectors import lerp, lower_median, norm

#: Ends of limbs that can be pinned and can touch; the pelvis, too, can be led to a point.
LIMBS = ("left_foot", "right_foot", "left_hand", "right_hand")
PELVIS = "pelvis"
#: s over which a limb comes to a pin or a touch, and leaves it.
EASE_S = 0.35
#: The same for the pelvis, which is heavier.
PELVIS_S = 0.7
#: m off the floor from which on a pinned foot hangs in the air; m out of reach that is worth a sentence.
HANGS_M, SHORT_M = 0.15, 0.01
#: See `limbs.soft_reach`: what is asked for is asked for, so legs may be nearly straight.
SOFT = 0.003
#: Where a limb is too short the body comes after it: by so much at most (m), evened over so long (s), in
#: so many rounds, each with so much of what is missing, until it is that near (m).
MOST_M, COME_S, ROUNDS, STEP, FINE_M = 0.15, 0.08, 8, 1.3, 1e-3


@dataclass(frozen=True)
class Pin:
    """A hand or foot that stays where it is.

    Attributes:
        limb: one of `LIMBS`.
        first, last: frames of the clip, both pinned; its place is that of the first, and a foot's turn.
    """

    limb: str
    first: int
    last: int


@dataclass(frozen=True)
class TouchPoint:
    """A point that a hand, a foot or the pelvis reaches.

    Attributes:
        limb: one of `LIMBS`, or `PELVIS`.
        frame: of the clip.
        point: m, in the clip's world.
    """

    limb: str
    frame: int
    point: tuple[float, float, float]


def end_of(skeleton: Skeleton, limb: str) -> int:
    """The joint of a limb's end: ankle or wrist.

    Raises:
        PoiseError: no such limb, or the skeleton has none.
    """
    if limb not in LIMBS:
        raise PoiseError(
            f"there is no limb '{limb}'", hint=did_you_mean(limb, list(LIMBS)), code="unknown-limb"
        )
    side, kind = limb.split("_")
    joints = find_anatomy(skeleton).of(kind, side)
    if not joints:
        raise PoiseError(
            f"the skeleton has no {side} {kind}", hint="Name another limb", code="body-part-missing"
        )
    return joints[0]


def ease(frames: int, first: int, last: int, fps: float, seconds: float = EASE_S) -> np.ndarray:
    """`(T,)` 1 from frame `first` to `last`, rising and falling in `seconds` along a smooth step."""
    t = np.arange(frames, dtype=float)
    away = np.maximum(np.maximum(first - t, t - last), 0.0) / (seconds * fps)
    left = np.clip(1.0 - away, 0.0, 1.0)
    return smoothstep(left)


def check_asked(clip: Clip, asked: Sequence[Pin | TouchPoint]) -> None:
    """Refuses what a clip cannot be led to.

    Raises:
        PoiseError: frames that the clip does not have, or limbs that the skeleton does not have.
    """
    for what in asked:
        first, last = _span(what)
        if not 0 <= first <= last < clip.frames:
            raise PoiseError(
                f"{what.limb} is wanted in frames {first} to {last}, and the clip has 0 to "
                f"{clip.frames - 1}",
                clip.name,
                code="frame-outside",
            )
        if isinstance(what, Pin) or what.limb != PELVIS:
            end_of(clip.skeleton, what.limb)


def _span(what: Pin | TouchPoint) -> tuple[int, int]:
    """The first and last frame in which a limb is held."""
    return (what.first, what.last) if isinstance(what, Pin) else (what.frame, what.frame)


def directed(
    clip: Clip, pins: Sequence[Pin] = (), touches: Sequence[TouchPoint] = ()
) -> tuple[Clip, tuple[str, ...]]:
    """The motion with limbs on their pins and touch points, and what of that is doubtful.

    A limb is led there by its own joints, and comes and goes in `EASE_S`; hands and feet keep their
    turn in the world, but for a pinned foot, which stays as it is from heel to toe. Where the limb is
    too short the body follows by a few centimetres, with its feet where they are; what is out of reach
    then is approached as far as it goes.

    Raises:
        PoiseError: frames that the clip does not have, or limbs that the skeleton does not have.
    """
    if not pins and not touches:
        return clip, ()
    check_asked(clip, (*pins, *touches))
    notes: list[str] = []
    root, rot = clip.arrays()
    # Limbs reach from where the pelvis is led.
    for what in (*sorted(touches, key=lambda t: t.limb != PELVIS), *pins):
        span = _span(what)
        if isinstance(what, TouchPoint) and what.limb == PELVIS:
            root, rot = _pelvis_led(clip, root, rot, what)
            continue
        joint = end_of(clip.skeleton, what.limb)
        pos = _ends(clip.skeleton, root, rot, joint)
        place = pos[span[0]] if isinstance(what, Pin) else np.array(what.point)
        share = ease(clip.frames, *span, clip.fps)[:, None]
        goal = lerp(pos, place, share)
        still = _foot(clip.skeleton, what.limb, root, rot, joint, (span[0], span[0]))
        root, rot = _led(clip, root, rot, joint, goal)
        if isinstance(what, Pin):
            rot = _still(clip.skeleton, root, rot, still, share[:, 0])
        notes += _doubts(clip, what, pos, _ends(clip.skeleton, root, rot, joint), place)
    return clip.replaced(root_pos=root, rot=rot), tuple(notes)


def pinned(clip: Clip, pins: Sequence[Pin]) -> Clip:
    """The motion with its pinned limbs at rest, each at its middle place while it is pinned.

    For a simulated motion, where friction holds a foot to within millimetres.
    """
    root, rot = clip.arrays()
    for pin in pins:
        joint = end_of(clip.skeleton, pin.limb)
        pos = _ends(clip.skeleton, root, rot, joint)
        last = min(pin.last, clip.frames - 1)
        place = lower_median(pos[pin.first : last + 1], 0)
        share = ease(clip.frames, pin.first, last, clip.fps)[:, None]
        goal = lerp(pos, place, share)
        still = _foot(clip.skeleton, pin.limb, root, rot, joint, (pin.first, last))
        root, rot = _led(clip, root, rot, joint, goal)
        rot = _still(clip.skeleton, root, rot, still, share[:, 0])
    return clip.replaced(root_pos=root, rot=rot)


def _foot(
    skeleton: Skeleton, limb: str, root: np.ndarray, rot: np.ndarray, joint: int, span: tuple[int, int]
) -> dict[int, np.ndarray]:
    """The mean turns in the world of a foot and of all that hangs on it, over a span; none of a hand."""
    if not limb.endswith("foot"):
        return {}
    of = [joint]
    of += [j for j in range(joint + 1, len(skeleton)) if skeleton.parents[j] in of]
    world = skeleton.forward(root, rot)[1][span[0] : span[1] + 1, of]
    sides = np.where((world * world[:1]).sum(-1, keepdims=True) < 0, -world, world)
    return dict(zip(of, normalize(sides.mean(0)), strict=True))


def _still(
    skeleton: Skeleton,
    root: np.ndarray,
    rot: np.ndarray,
    still: dict[int, np.ndarray],
    share: np.ndarray,
) -> np.ndarray:
    """Rotations with joints turned in the world by a share `(T)` of the way to how they stay."""
    rot, world = rot.copy(), skeleton.forward(root, rot)[1]
    for j, turn in still.items():
        wanted = slerp(world[:, j], turn, share)
        above = world[:, skeleton.parents[j]]
        rot[:, j] = np.where(share[:, None] > 0, quat_mul(quat_conj(above), wanted), rot[:, j])
        world[:, j] = np.where(share[:, None] > 0, wanted, world[:, j])
    return rot


def _led(
    clip: Clip, root: np.ndarray, rot: np.ndarray, joint: int, goal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Root and rotations with the end of a limb on its goal `(T, 3)`.

    Where the limb is too short the whole body comes after it, smoothly and by `MOST_M` at most, with
    feet that stay where they are.
    """
    skeleton, start, shift = clip.skeleton, rot, np.zeros_like(root)
    feet = [j for j in find_anatomy(skeleton).of("foot") if j != joint]
    goals: dict[int | str, np.ndarray] = {j: _ends(skeleton, root, rot, j) for j in feet}
    for _ in range(ROUNDS):
        kept = goals if bool(shift.any()) else {}
        rot = match_positions(skeleton, start, root + shift, {**kept, joint: goal}, soft=SOFT)
        miss = goal - _ends(skeleton, root + shift, rot, joint)
        if float(norm(miss).max()) < FINE_M:
            break
        sums, weight, _ = gaussian_sums(miss, COME_S * clip.fps)
        shift = shift + STEP * sums / weight
        shift = shift * (MOST_M / np.maximum(norm(shift, keepdims=True), MOST_M))
    moved = np.abs(rot - start).max((1, 2)) > 0
    touched = moved & (norm(goal - _ends(skeleton, root, start, joint)) > 0) | shift.any(-1)
    return root + shift, np.where(touched[:, None, None], rot, start)


def _pelvis_led(
    clip: Clip, root: np.ndarray, rot: np.ndarray, what: TouchPoint
) -> tuple[np.ndarray, np.ndarray]:
    """Root and rotations with the root at a point in one frame, and feet where they are as far as legs
    reach."""
    skeleton = clip.skeleton
    feet: dict[int | str, np.ndarray] = {
        j: _ends(skeleton, root, rot, j) for j in find_anatomy(skeleton).of("foot")
    }
    share = ease(clip.frames, what.frame, what.frame, clip.fps, PELVIS_S)[:, None]
    moved = root + share * (np.array(what.point) - root[what.frame])
    led = match_positions(skeleton, rot, moved, feet, soft=SOFT)
    return moved, np.where((share > 0)[:, None], led, rot)


def _ends(skeleton: Skeleton, root: np.ndarray, rot: np.ndarray, joint: int) -> np.ndarray:
    return skeleton.forward(root, rot)[0][:, joint]


def _doubts(
    clip: Clip, what: Pin | TouchPoint, before: np.ndarray, after: np.ndarray, place: np.ndarray
) -> list[str]:
    """What a director should know of a pin or a touch."""
    span = (what.first, what.last) if isinstance(what, Pin) else (what.frame, what.frame)
    short = norm(after[span[0] : span[1] + 1] - place)
    said: list[str] = []
    if float(short.max()) > SHORT_M:
        k = span[0] + int(short.argmax())
        said.append(
            f"{what.limb} cannot reach where it is wanted: {100 * float(short.max()):.0f} cm are "
            f"missing at frame {k}; it comes as near as it gets."
        )
    height = float(place[2]) - float(before[:, 2].min())
    if isinstance(what, Pin) and what.limb.endswith("foot") and height > HANGS_M:
        said.append(
            f"{what.limb} is pinned in mid-air from frame {what.first} on, {100 * height:.0f} cm above "
            "where it is lowest: nothing holds it there but the body's balance."
        )
    return said
