"""Arms and legs put where they should be: two bones solved in closed form, many frames at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.motion import Skeleton
from poise.motion.rotations import (
    across,
    axis_angle_to_quat,
    normalize,
    quat_between,
    quat_mul,
    quat_rotate,
    quat_rotate_inv,
    shortest_arc,
)
from poise.motion.smoothing import find_runs, smoothstep
from poise.motion.vectors import cross, norm

#: The share of a limb's length over which it slows down before it is straight.
SOFT = 0.02
#: Sine of a bend below which the limb's usual bend plane takes over from the one of the moment.
STRAIGHT = 0.1
#: Sine of a bend from which on the side to which a limb bends is told.
BENT = 0.02
#: Sine of a bend beyond straight from which on a limb is not stretched but bends that way.
BACKWARDS = 0.25
_LIMBS = {"foot": ("thigh", "shin"), "hand": ("upper_arm", "forearm")}


class Limb(NamedTuple):
    """The joints of one limb: where it starts (hip), bends (knee) and ends (ankle)."""

    root: int
    mid: int
    end: int


def soft_reach(distance: np.ndarray, l1: np.ndarray, l2: np.ndarray, soft: float = SOFT) -> np.ndarray:
    """The distance `(...)` m that a limb spans when it is asked for `distance`.

    Up to L (1 - soft), with L = l1 + l2, it is the distance itself; beyond, it nears L exponentially, so
    that a knee never snaps straight: d' = L - s exp(-(d - L + s) / s) with s = soft L. `soft` 0 clamps
    at L. Never nearer than |l1 - l2|.
    """
    length = l1 + l2
    s = np.maximum(soft * length, 1e-12)
    eased = length - s * np.exp(-np.maximum((distance - length + s) / s, 0.0))
    return np.maximum(np.where(distance > length - s, eased, distance), np.abs(l1 - l2))


def limb_of(skeleton: Skeleton, joint: int | str) -> Limb:
    """The joints that move a hand or foot: those of the anatomy, else the two bones above `joint`."""
    end = skeleton.index(joint) if isinstance(joint, str) else joint
    try:
        parts = find_anatomy(skeleton).parts
    except PoiseError:
        parts = ()
    part = next((p for p in parts if p.joint == end and p.kind in _LIMBS), None)
    if part is not None:
        root, mid = (
            next(p.joint for p in parts if p.kind == kind and p.side == part.side)
            for kind in _LIMBS[part.kind]
        )
        return Limb(root, mid, end)
    chain, j = [end], end
    while len(chain) < 3 and skeleton.parents[j] >= 0:
        length = float(np.linalg.norm(skeleton.offsets[j]))
        j = skeleton.parents[j]
        # Joints at one place are one joint.
        if length > 1e-4:
            chain.append(j)
    if len(chain) < 3:
        raise PoiseError(
            f"joint '{skeleton.names[end]}' has no two bones above it",
            skeleton.source.path,
            code="limb-too-short",
        )
    return Limb(chain[2], chain[1], chain[0])


def match_positions(
    skeleton: Skeleton,
    rot: np.ndarray,
    root_pos: np.ndarray,
    targets: Mapping[int | str, np.ndarray],
    limbs: Mapping[int | str, Limb] | None = None,
    soft: float = SOFT,
    fold: float = math.pi,
) -> np.ndarray:
    """The motion with hands and feet on their targets and all else kept: new `rot (T, J, 4)` wxyz.

    The knee or elbow is bent to the right length about its own axis, then the whole limb swings by the
    smallest turn; hands and feet keep their world rotation. Where a limb is straight, its usual bend
    plane over the clip holds, so that it does not flip. Targets equal to what is there change nothing.

    Args:
        rot: `(T, J, 4)` wxyz local. root_pos: `(T, 3)` m.
        targets: `(T, 3)` m world of each joint, by index or name; a NaN row leaves its frame free.
        limbs: which joints move a target, `limb_of` by default.
        soft: see `soft_reach`; a limb that the motion itself holds straighter may stay so.
        fold: rad, bend of a knee or elbow beyond which none is bent that the motion itself does not bend
            so far.
    """
    out = rot.copy()
    for joint, goal in targets.items():
        limb = (limbs or {}).get(joint) or limb_of(skeleton, joint)
        pos, quat = skeleton.forward(root_pos, out)
        now = pos[:, limb.end]
        goal = np.where(np.isfinite(goal).all(-1, keepdims=True), goal, now)
        hip, knee = pos[:, limb.root], pos[:, limb.mid]
        bend, swing = _reach(hip, knee, now, goal, quat[:, limb.root], soft, fold)
        _turn(skeleton, out, quat, limb, bend, swing)
    return normalize(out)


def _reach(
    root: np.ndarray,
    mid: np.ndarray,
    end: np.ndarray,
    goal: np.ndarray,
    upper_quat: np.ndarray,
    soft: float,
    fold: float,
) -> tuple[np.ndarray, np.ndarray]:
    """World turns (wxyz) of the lower bone about the knee, then of the whole limb about its root."""
    u, v = root - mid, end - mid
    l1, l2 = norm(u), norm(v)
    now, want = norm(end - root), norm(goal - root)
    # A limb that is straighter than the soft reach allows may stay as straight as it is.
    span = np.maximum(soft_reach(want, l1, l2, soft), np.minimum(want, now))
    if fold < math.pi:
        # The same at the other end, e exp((d - n - e) / e) below n + e for the nearest span n.
        nearest = np.sqrt(np.maximum(l1**2 + l2**2 + 2 * l1 * l2 * math.cos(fold), 0.0))
        ease = np.maximum(soft * (l1 + l2), 1e-12)
        eased = nearest + ease * np.exp(np.minimum((span - nearest - ease) / ease, 0.0))
        eased = np.where(span < nearest + ease, eased, span)
        span = np.minimum(eased, np.maximum(span, now))
    axis, sine = _bend_axis(-u, v, upper_quat)
    span = now + _through_straight(sine) * (span - now)
    # |u - R v|^2 = d^2 gives A cos(delta) + B sin(delta) = (|u|^2 + |v|^2 - d^2) / 2 - C for R the turn
    # by delta about the axis n: A = u_n . v_n (parts across n), B = u . (n x v), C = (u . n) (v . n).
    c = (u * axis).sum(-1) * (v * axis).sum(-1)
    a = (u * v).sum(-1) - c
    b = (u * cross(axis, v)).sum(-1)
    size = np.maximum(np.hypot(a, b), 1e-12)
    fold = np.arctan2(b, a)
    open_by = np.arccos(np.clip(((l1**2 + l2**2 - span**2) / 2 - c) / size, -1.0, 1.0))
    # The limb is folded at delta = fold; it bends on the axis' positive side, except where it is
    # stretched beyond straight and need not bend more than about that, or really bends that way.
    flexion = math.pi - open_by
    little = flexion < 1.5 * np.arcsin(np.clip(-sine, 0.0, 1.0)) + 1e-9
    over = np.zeros_like(little)
    for first, last in find_runs((sine < 0), 0):
        spell = slice(first, last + 1)
        # One side for a whole spell: a knee that changed it within one would jump.
        over[spell] = bool(little[spell].all()) or float(sine[spell].min()) < -BACKWARDS
    delta = fold - np.where(over, -open_by, open_by)
    delta = np.remainder(delta + math.pi, 2 * math.pi) - math.pi
    # Nothing to do stays nothing to do, whatever rounding says about a straight limb.
    delta = np.where(np.abs(span - now) < 1e-12, np.zeros_like(delta), delta)
    bend = axis_angle_to_quat(axis, delta)
    reached = quat_rotate(bend, v) - u
    return bend, shortest_arc(reached, goal - root)


def _through_straight(sine: np.ndarray) -> np.ndarray:
    """`(T,)`, how much of a correction a limb gets that bends either way, by the sine of its bend.

    One that really bends backwards passes through straight on its way. What shortens it there would
    bend it to one side before and to the other after that, in a jump; so nothing does.
    """
    share = np.ones_like(sine)
    small = np.minimum(np.abs(sine) / BACKWARDS, 1.0)
    for first, last in find_runs((sine < 0), 0):
        if float(sine[first : last + 1].min()) >= -BACKWARDS:
            continue
        while first > 0 and 0 <= float(sine[first - 1]) < BACKWARDS:
            first -= 1
        while last + 1 < len(sine) and 0 <= float(sine[last + 1]) < BACKWARDS:
            last += 1
        share[first : last + 1] = small[first : last + 1]
    return share


def _bend_axis(
    upper: np.ndarray, lower: np.ndarray, upper_quat: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The unit axis `(T, 3)` about which a limb bends, and the signed sine of its bend about it.

    Where it is nearly straight, the mean axis of the clip in the upper bone's own frame.
    """
    own = quat_rotate_inv(upper_quat, cross(normalize(upper), normalize(lower)))
    signed = _side(own)[..., None] * own
    usual = signed.sum(0)
    if float(norm(usual)) < 1e-6 * len(own):
        usual = across(quat_rotate_inv(upper_quat, upper)[0])
    usual = np.broadcast_to(normalize(usual), own.shape)
    size = norm(own, keepdims=True)
    # Full weight on the moment's own axis from 2 * STRAIGHT on.
    share = np.clip((size - STRAIGHT) / STRAIGHT, 0.0, 1.0)
    share = smoothstep(share)
    mixed = share * signed / np.maximum(size, 1e-12) + (1 - share) * usual
    axis = normalize(np.where(norm(mixed, keepdims=True) < 0.1, usual, mixed))
    return quat_rotate(upper_quat, axis), (own * axis).sum(-1)


def _side(own: np.ndarray) -> np.ndarray:
    """`(T,)` 1 where a limb bends to its usual side, -1 where it is stretched beyond straight.

    own: `(T, 3)`, the axis of its bend in the upper bone's frame, as long as the bend's sine. It turns
    round as the limb passes through straight; where it turns without that, the side is the same.
    """
    bent = np.flatnonzero(norm(own) > BENT)
    if not len(bent):
        return np.ones(len(own), dtype=own.dtype)
    same = (own[bent[1:]] * own[bent[:-1]]).sum(-1) >= 0
    ones = np.ones(1, dtype=own.dtype)
    side = np.concatenate((ones, np.where(same, 1.0, -1.0))).cumprod(0)
    if float((side * np.square(own[bent]).sum(-1)).sum()) < 0:
        side = -side
    last = np.maximum(np.searchsorted(bent, np.arange(len(own)), side="right") - 1, 0)
    return side[last]


def _turn(
    skeleton: Skeleton,
    rot: np.ndarray,
    quat: np.ndarray,
    limb: Limb,
    bend: np.ndarray,
    swing: np.ndarray,
) -> None:
    """Writes the turns into the local rotations; the end keeps its world rotation `quat`."""
    parents = skeleton.parents
    both = quat_mul(swing, bend)

    def above(j: int) -> np.ndarray:
        one = np.zeros_like(swing)
        one[:, 0] = 1.0
        return quat[:, parents[j]] if parents[j] >= 0 else one

    rot[:, limb.root] = quat_between(above(limb.root), quat_mul(swing, quat[:, limb.root]))
    rot[:, limb.mid] = quat_between(above(limb.mid), quat_mul(bend, quat[:, limb.mid]))
    rot[:, limb.end] = quat_between(quat_mul(both, above(limb.end)), quat[:, limb.end])
