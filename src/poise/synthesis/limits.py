"""Limits of a filled gap: speeds, heights, flights by gravity, and seams that meet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.kinematics.feet import Motion
from poise.kinematics.steps import hermite
from poise.motion import Skeleton
from poise.motion.rotations import (
    GRAVITY,
    normalize,
    quat_conj,
    quat_mul,
    quat_to_rotvec,
    rotvec_to_quat,
    slerp,
    unwrap_quats,
)
from poise.motion.smoothing import smoothstep
from poise.motion.vectors import lerp, norm

#: m/s, the fastest of a thousand frames of each part in CMU's motions and DeepMimic's (30 Hz, 62 clips).
FASTEST = {
    "pelvis": 4.0,
    "spine": 3.5,
    "neck": 3.6,
    "head": 3.6,
    "clavicle": 3.5,
    "upper_arm": 4.0,
    "forearm": 6.5,
    "hand": 9.0,
    "thigh": 4.0,
    "shin": 6.5,
    "foot": 10.0,
}
#: Shares of the network's motion that are tried, the rest being interpolated.
SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
#: m above its height on the floor from which on a body is in the air.
ALOFT_M = 0.12
#: What is done with the feet of a gap: held where the network says that they stand, led from one place
#: where they stand to the next (`kinematics.steps`), or left alone.
Feet = Literal["held", "stepped", "free"]


def fastest(skeleton: Skeleton) -> np.ndarray:
    """`(J,)` m/s that each joint reaches at most; infinite where a joint is no known part of a body."""
    out = np.full((len(skeleton),), np.inf)
    try:
        parts = find_anatomy(skeleton).parts
    except PoiseError:
        return out
    for part in parts:
        out[part.joint] = FASTEST.get(part.kind, np.inf)
    return out


def excess(skeleton: Skeleton, limits: np.ndarray, motion: Motion, fps: float) -> tuple[float, int]:
    """By how much the fastest joint goes beyond its limit, as a factor, and which one it is."""
    pos = skeleton.forward(*motion)[0]
    over = (norm(np.diff(pos, axis=0)) * fps).max(0) / limits
    joint = int(over.argmax())
    return float(over[joint]), joint


class Calmed(NamedTuple):
    """A gap that keeps to what people reach.

    Attributes:
        motion: its frames.
        share: of the network's motion in them; the rest is interpolated.
        feet: what is done with them.
        over: by which factor the fastest joint goes beyond its limit all the same, 1 at most if not.
    """

    motion: Motion
    share: float
    feet: Feet
    over: float


def calmed(
    made: Motion,
    plain: Motion,
    finish: Callable[[Motion, Feet], Motion],
    over: Callable[[Motion], float],
    ways: Sequence[Feet] = ("held", "free"),
    most: float = 1.0,
) -> Calmed:
    """The motion with as much of the network's as keeps every joint within its limit.

    Feet are held while that is possible: where they are held in places that they cannot reach in time,
    nothing of the network's motion helps, and the next of `ways` is tried.

    Args:
        made: what the network makes of a gap. plain: the gap interpolated.
        finish: a gap's frames as they are delivered, with ends met, and with feet in one of the ways.
        over: by which factor the fastest joint of finished frames goes beyond its limit.
        most: the largest share of the network's motion.
    """
    best: Calmed | None = None
    for way in ways:
        for share in (x for x in SHARES if x <= most):
            part = np.full(made[1].shape[:2], share)
            mixed = lerp(plain[0], made[0], part[:, :1]), slerp(plain[1], made[1], part)
            done = finish(mixed, way)
            tried = Calmed(done, share, way, over(done))
            if tried.over <= 1.0:
                return tried
            if best is None or tried.over < best.over:
                best = tried
    assert best is not None
    return best


#: Depth of the crouch before and after a jump, as a share of its height, and between which it lies, m; s
#: that it takes to go down.
CROUCH, CROUCHES_M, CROUCH_S = 0.7, (0.08, 0.3), 0.35
#: s in which a body gets from rest to the level speed of its flight, besides those of pushing off; and
#: how many times as long that is as its way at this speed would take.
LEAN_S, RUN_UP = 0.18, 2.5
#: rad that the trunk leans ahead in the deepest crouch before a jump, and after it.
LEANS = (0.45, 0.15)


class Flown(NamedTuple):
    """A gap with an end in the air.

    Attributes:
        height: `(n,)` m, of the root.
        in_air: `(n,)` bool.
        level: `(n, 2)` m, of the root.
        falls: s that it is in the air after the first and before the last keyframe.
        lean: `(n,)` rad that the trunk leans ahead.
    """

    height: np.ndarray
    in_air: np.ndarray
    level: np.ndarray
    falls: tuple[float, float]
    lean: np.ndarray


def fall_s(height: float) -> float:
    """t = sqrt(2 h / g)."""
    return (2.0 * max(height, 0.0) / GRAVITY) ** 0.5


def crouch_of(height: float) -> tuple[float, float]:
    """How deep (m) a body crouches for a jump, and the s in which it pushes off from there: evenly
    accelerated to v = g t over the depth d, 2 d / v."""
    depth = min(max(CROUCH * height, CROUCHES_M[0]), CROUCHES_M[1])
    return depth, 2.0 * depth / (GRAVITY * max(fall_s(height), 1e-6))


def start_s(height: float) -> float:
    """s on the floor beside a flight in which a body goes ahead, half as fast as in the air."""
    return crouch_of(height)[1] + LEAN_S


def flight_speeds(
    places: np.ndarray, keys: Sequence[int], aloft: Mapping[int, float], fps: float
) -> dict[int, np.ndarray]:
    """The level velocity `(2,)` m/s at each keyframe in the air, the same before it and after it.

    With the ways D to the keyframes on either side, f s of each in the air and p s on the floor beside
    it, which cover half of what flight does in the time, it is the least squares solution of
    v (f + p / 2) = D. Where frames after the last keyframe or before the first are kept, they say it.

    Args:
        places: `(T, 2)` m, the root in all frames.
        keys: all keyframes. aloft: m that each is in the air.
    """
    out: dict[int, np.ndarray] = {}
    for k in (k for k in keys if aloft.get(k, 0.0) > 0.0):
        if k == keys[-1] and k + 1 < len(places):
            out[k] = (places[k + 1] - places[k]) * fps
        elif k == keys[0] and k > 0:
            out[k] = (places[k] - places[k - 1]) * fps
        else:
            out[k] = _speed(places, keys, aloft, k, fps)
    return out


def _speed(
    places: np.ndarray, keys: Sequence[int], aloft: Mapping[int, float], k: int, fps: float
) -> np.ndarray:
    number = list(keys).index(k)
    above, below = np.zeros(2, dtype=places.dtype), 0.0
    fall, push = fall_s(aloft[k]), start_s(aloft[k])
    for other in (number - 1, number + 1):
        if not 0 <= other < len(keys):
            continue
        n = keys[other]
        whole, way = abs(n - k) / fps, (places[n] - places[k]) * (1 if n > k else -1)
        here = min(fall + 0.5 * push, whole)
        if aloft.get(n, 0.0) > 0.0:
            between = whole >= fall + fall_s(aloft[n])
            # With a landing between, each flight has its share of the way.
            way, here = (0.5 * way, min(fall, 0.5 * whole)) if between else (way, whole)
        above = above + here * way
        below += here * here
    return above / max(below, 1e-9)


def flown(
    height: np.ndarray,
    ends: np.ndarray,
    before: float,
    after: float,
    fps: float,
    speeds: tuple[np.ndarray | None, np.ndarray | None] = (None, None),
) -> Flown:
    """A root in a gap of n frames with an end in the air: there it rises or falls by gravity.

    A keyframe in the air is taken as the top of its flight, so that the root leaves the floor
    t = sqrt(2 h / g) before it and comes back as long after it: z(t) = z_key - g t^2 / 2. It takes off
    with v = g t from a crouch of depth d, evenly accelerated over 2 d / v, and lands in one alike. In
    the air it goes ahead evenly, and gets to that speed from rest, or from it to rest, on the floor.
    Two keyframes too near to one another for that are of one flight, a parabola through both.

    Args:
        height: `(n,)` m, the root on the straight line between the keyframes, without these.
        ends: `(2, 2)` m, where the keyframes have the root.
        before, after: how high (m) the keyframes are off the floor, 0 where they stand on it.
        speeds: `(2,)` m/s in the air beside each; from its way alone by default.
    """
    n = len(height)
    t = np.arange(1, n + 1, dtype=height.dtype) / fps
    whole = (n + 1) / fps
    falls = fall_s(before), fall_s(after)
    if whole < sum(falls) and before > 0.0 and after > 0.0:
        rise = 0.5 * GRAVITY * t * (whole - t)
        level = lerp(ends[0], ends[1], (t / whole)[:, None])
        all_ = np.ones(n, dtype=bool)
        return Flown(height + rise, all_, level, (whole, whole), np.zeros_like(height))
    out, in_air, lean = height.copy(), np.zeros(n, dtype=bool), np.zeros_like(height)
    sides = (before, falls[0], t, LEANS[1]), (after, falls[1], whole - t, LEANS[0])
    for off, fall, since, most in sides:
        if off <= 0.0:
            continue
        # The line's own rise goes, and what is left where the gap ends before the flight does.
        flight = np.maximum(off - 0.5 * GRAVITY * since**2, 0.0)
        rest = max(0.0, off - 0.5 * GRAVITY * whole**2)
        out = out + flight - (rest * since + off * (whole - since)) / whole
        depth, push = crouch_of(off)
        down = _crouch(since - fall, depth, push, whole - fall)
        out, lean = out - down, lean + most / depth * down
        in_air |= since < fall
    falls = (min(falls[0], whole), min(falls[1], whole))
    level = _ahead(t, whole, ends, (before, after), falls, speeds)
    return Flown(out, in_air, level, falls, lean)


def _ahead(
    t: np.ndarray,
    whole: float,
    ends: np.ndarray,
    off: tuple[float, float],
    falls: tuple[float, float],
    speeds: tuple[np.ndarray | None, np.ndarray | None],
) -> np.ndarray:
    """`(n, 2)` m, the level way of a root at times `t` of a gap of `whole` s."""
    flies = off[0] > 0.0, off[1] > 0.0
    if not any(flies):
        return lerp(ends[0], ends[1], (t / whole)[:, None])
    way, push = ends[1] - ends[0], [start_s(h) for h in off]
    alone = way / max(sum(f + 0.5 * p for f, p, up in zip(falls, push, flies, strict=True) if up), 1e-6)
    v = [alone if one is None else one for one in speeds]
    v = [x if up else np.zeros_like(way) for x, up in zip(v, flies, strict=True)]
    # On the floor: from where the first flight lands to where the second begins.
    start, stop = ends[0] + falls[0] * v[0], ends[1] - falls[1] * v[1]
    ground = max(whole - sum(falls), 0.0)
    longest = ground
    if not all(flies):
        k = 0 if flies[0] else 1
        longest = RUN_UP * float(norm(stop - start)) / max(float(norm(v[k])), 1e-6)
        longest = min(max(longest, crouch_of(off[k])[1]), ground)
    begins = falls[0] if flies[0] else whole - falls[1] - longest
    u = np.clip((t - begins) / max(longest, 1e-6), 0.0, 1.0)[:, None]
    out = hermite(u, start, stop, v[0] * longest, v[1] * longest)
    out = np.where((t < falls[0])[:, None], ends[0] + t[:, None] * v[0], out)
    return np.where((whole - t < falls[1])[:, None], ends[1] - (whole - t)[:, None] * v[1], out)


def _crouch(since: np.ndarray, depth: float, push: float, room_s: float) -> np.ndarray:
    """How deep (m) a body crouches, `since` seconds before it takes off or after it landed.

    depth: at most, m. push: s from there to the take-off. room_s: what there is of the gap.
    """
    speed = 2.0 * depth / push
    if room_s < push + CROUCH_S:
        return np.zeros_like(since)
    pushing = depth - 0.5 * speed / push * (push - since) ** 2
    sinking = 0.5 * depth * (1.0 + np.cos(np.pi * (since - push) / CROUCH_S))
    down = np.where(since <= push, pushing, sinking)
    return np.where((since > 0.0) & (since < push + CROUCH_S), down, 0.0)


def sampled(root: np.ndarray, rot: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames at real-valued places `at (K)` of a path: positions on a cubic, rotations by arcs.

    root `(T, 3)`, rot `(T, J, 4)`. The cubic is Catmull and Rom's, which runs through every frame.
    """
    last = len(root) - 1
    low = np.clip(np.floor(at).astype(int), 0, max(0, last - 1))
    t = (at - low)[..., None]
    if last == 0:
        return np.broadcast_to(root, (len(at), 3)), np.broadcast_to(rot, (len(at), *rot.shape[1:]))
    p = [root[np.clip(low + k, 0, last)] for k in (-1, 0, 1, 2)]
    cubic = (
        p[1]
        + 0.5 * t * (p[2] - p[0])
        + t**2 * (p[0] - 2.5 * p[1] + 2 * p[2] - 0.5 * p[3])
        + t**3 * (1.5 * (p[1] - p[2]) + 0.5 * (p[3] - p[0]))
    )
    return cubic, slerp(rot[low], rot[low + 1], t)


def fade(count: int, frames: int) -> np.ndarray:
    """Weights `(count)` from 1 at the first frame down to 0 after `frames`, and at the last frame."""
    reach = max(1, min(frames, count - 1))
    t = np.minimum(np.arange(count, dtype=float) / reach, 1.0)
    return 0.5 * (1 + np.cos(np.pi * t))


def spread(
    ends: tuple[np.ndarray, np.ndarray], made: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Generated frames that lead from one kept frame to another, with what they miss of either spread
    over all of them.

        y(i) += (1 - s(i)) (x(0) - (2 y(1) - y(2))) + s(i) (x(n+1) - (2 y(n) - y(n-1))),

    with s from 0 to 1 along a smooth step, and for rotations the same in turns: an end that the motion
    misses by far is not made up for in a jerk.

    Args:
        ends: root `(2, 3)` and rotations `(2, J, 4)` of the kept frames.
        made: root `(n, 3)` and rotations `(n, J, 4)` between them.
    """
    (ends_root, ends_rot), (root, rot) = ends, made
    n = len(root)
    if n < 2:
        return root.copy(), rot.copy()
    t = np.arange(1, n + 1, dtype=root.dtype) / (n + 1)
    ease = smoothstep(t)
    shift, turn = np.zeros_like(root), np.zeros((n, rot.shape[1], 3), dtype=rot.dtype)
    for k, (a, b), weight in ((0, (1, 0), 1 - ease), (1, (n - 2, n - 1), ease)):
        place, pose = _ahead_seams(root, rot, a, b)
        shift += weight[:, None] * (ends_root[k] - place)
        turn += weight[:, None, None] * quat_to_rotvec(quat_mul(ends_rot[k], quat_conj(pose)))
    return root + shift, normalize(quat_mul(rotvec_to_quat(turn), rot))


def meet(
    root: np.ndarray, rot: np.ndarray, before: int, after: int, blend: int
) -> tuple[np.ndarray, np.ndarray]:
    """A path; its generated middle leaves and reaches the kept frames at their speed.

        y(1) = x(0) + (x(0) - x(-1)),   y(n) = x(n+1) - (x(n+2) - x(n+1)),

    and for rotations the same in turns. What that asks for is added to the frames between and fades
    over `blend` frames. A lone kept frame at the end has no speed of its own: what is missing from where
    the motion leads to it is made up over the last `blend` frames. A single frame between two moving
    ends takes the mean of both wishes.

    Args:
        root `(T, 3)`, rot `(T, J, 4)`: kept frames, generated frames, kept frames.
        before, after: how many frames are kept at the beginning and at the end.
    """
    root, rot = root.copy(), unwrap_quats(rot)
    n = len(root) - before - after
    if n < 1:
        return root, rot
    gap = slice(before, before + n)
    wishes = []
    if before >= 2:
        wishes.append((_ahead_seams(root, rot, before - 2, before - 1), 0, fade(n, blend)))
    if after >= 2:
        end = before + n
        wishes.append((_ahead_seams(root, rot, end + 1, end), n - 1, np.flip(fade(n, blend), 0)))
    share = 1.0 if n > 1 else 1.0 / max(1, len(wishes))
    shift, turn = np.zeros_like(root[gap]), np.zeros((n, rot.shape[1], 3), dtype=rot.dtype)
    for (place, pose), at, weight in wishes:
        weight = weight * share
        shift += weight[:, None] * (place - root[before + at])
        apart = quat_to_rotvec(quat_mul(pose, quat_conj(rot[before + at])))
        turn += weight[:, None, None] * apart
    if after == 1 and n > 1:
        # y(i) += s(i) (x(n+1) - (2 y(n) - y(n-1))),  s from 0 to 1 along a smooth step
        t = np.maximum(np.arange(n, dtype=root.dtype) - (n - 1 - min(blend, n - 1)), 0)
        t = t / (min(blend, n - 1) + 1)
        ease = smoothstep(t)
        place, pose = _ahead_seams(root, rot, before + n - 2, before + n - 1)
        shift += ease[:, None] * (root[before + n] - place)
        turn += ease[:, None, None] * quat_to_rotvec(quat_mul(rot[before + n], quat_conj(pose)))
    root[gap] += shift
    rot[gap] = normalize(quat_mul(rotvec_to_quat(turn), rot[gap]))
    return root, unwrap_quats(rot)


def _ahead_seams(root: np.ndarray, rot: np.ndarray, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the motion from frame `a` to frame `b` leads one frame later."""
    return 2 * root[b] - root[a], quat_mul(quat_mul(rot[b], quat_conj(rot[a])), rot[b])
