"""Steps of feet over a gap: as few as there may be, planned, walked, put in where they are missing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.kinematics.feet import Motion, Sole
from poise.kinematics.hold import FIRM, SOFT, Lead, StandingFoot, hold, led
from poise.kinematics.limbs import limb_of, match_positions
from poise.motion import Skeleton
from poise.motion.rotations import (
    axis_angle_to_quat,
    normalize,
    quat_between,
    quat_mul,
    quat_rotate,
    shortest_arc,
    slerp,
)
from poise.motion.smoothing import find_runs, smooth_lift, smoothstep
from poise.motion.vectors import cross, lerp, norm

#: Below this distance (m) of ankle or toes, whichever is less, a foot shuffles, turns or rolls.
LEAST_M = 0.05
#: Seconds that a step takes: those of a short one, and more for every metre.
SWING_S, SWING_S_PER_M = 0.3, 0.15
#: How far (m) the lowest end of a foot is above the floor in the middle of a swing: the median of 580
#: swings of CMU clips, of all lengths from 0.1 to 1.5 m.
CLEAR_M = 0.05
#: What a step may have of the gap, and what is left standing at its ends, in frames.
_MOST_OF_GAP, _EDGE_FRAMES = 0.45, 2
#: The share of a swing, about its middle, in which a foot must be clear.
_MIDDLE = 0.6


class FootStep(NamedTuple):
    """A foot swings in the frames `start` to `stop` (exclusive)."""

    foot: int
    start: int
    stop: int


def missing_steps(soles: np.ndarray, stands: np.ndarray, fps: float) -> tuple[FootStep, ...]:
    """The steps that must be taken for feet to stand where both ends of a gap have them.

    Args:
        soles: `(T, K, 2, 3)` m, ankles and toes of K feet, the first and last frame being kept ones.
        stands: `(T, K)` bool.

    A foot that stands in all frames and is farther than `LEAST_M` from where it was swings while the
    other feet stand, and as near as can be to when the transition moves it. Of several the one that is
    moved first steps first.
    """
    (frames, feet), ankles = soles.shape[:2], soles[:, :, 0]
    apart = norm(soles[-1, ..., :2] - soles[0, ..., :2]).min(-1)
    wanting = [k for k in range(feet) if bool(stands[:, k].all()) and apart[k] > LEAST_M]
    stands = stands.copy()
    found: list[FootStep] = []
    for k in sorted(wanting, key=lambda k: _moved(ankles[:, k])):
        seconds = SWING_S + SWING_S_PER_M * float(apart[k])
        length = round(min(seconds * fps, _MOST_OF_GAP * frames))
        if length < 2 or frames < length + 2 * _EDGE_FRAMES:
            continue
        others = [j for j in range(feet) if j != k]
        later = len(wanting) - len(found) - 1
        busy = np.asarray(~stands[:, others].all(1))
        start = _when(_moved(ankles[:, k]), busy, length, later)
        found.append(FootStep(k, start, start + length))
        stands[start : start + length, k] = False
    return tuple(found)


def stepping(
    stands: np.ndarray, steps: Sequence[FootStep], columns: Sequence[Sequence[int]]
) -> np.ndarray:
    """Contacts `(T, F)` with the feet of `steps` off the floor; columns: those of every foot."""
    stands = stands.copy()
    for step in steps:
        stands[step.start : step.stop, list(columns[step.foot])] = False
    return stands


def rises(soles: np.ndarray, stands: np.ndarray) -> np.ndarray:
    """`(T, K)` m, how much higher feet must be for each to be `CLEAR_M` clear of the floor in mid-swing.

    Args:
        soles: `(T, K, 2, 3)` m, of a gap with one kept frame at each end.
        stands: `(T, K)` bool.

    The floor is at the lowest place of each end of the foot. Of a swing by more than `LEAST_M` the
    height h(t) above it is to be at least `CLEAR_M sin(pi t)`, by A sin^2(pi t) more.
    """
    height = soles[..., 2] - soles[..., 2].min(0)
    low, up = height.min(-1), np.zeros(stands.shape, dtype=soles.dtype)
    free = ~stands
    free[[0, -1]] = False
    for k in range(stands.shape[1]):
        for first, last in find_runs(free[:, k], 0):
            gone = soles[last + 1, k, :, :2] - soles[first - 1, k, :, :2]
            if norm(gone).min() <= LEAST_M:
                continue
            count = last - first + 1
            t = np.arange(1, count + 1, dtype=soles.dtype) / (count + 1)
            arc = np.sin(np.pi * t)
            short = (CLEAR_M * arc - low[first : last + 1, k]) / arc**2
            inner = np.abs(t - 0.5) <= 0.5 * _MIDDLE
            if bool(inner.any()):
                up[first : last + 1, k] = np.clip(short[inner].max(), 0, CLEAR_M) * arc**2
    return up


def _moved(path: np.ndarray) -> float:
    """The frame by which half of the way `(T, 3)` is done."""
    way = norm(np.diff(path[:, :2], axis=0)).cumsum(0)
    return float((way < 0.5 * way[-1]).sum())


def _when(middle: float, busy: np.ndarray, length: int, later: int) -> int:
    """The frame in which a step of `length` frames begins: with little of it while other feet are in
    the air (`busy (T)`), room after it for `later` more steps, then near `middle`."""
    frames = len(busy)
    last = max(_EDGE_FRAMES, frames - _EDGE_FRAMES - (later + 1) * length)
    starts = np.arange(_EDGE_FRAMES, last + 1)
    in_air = np.concatenate((np.zeros(1), busy.astype(float).cumsum(0)))
    clash = in_air[starts + length] - in_air[starts]
    off = np.abs(starts + 0.5 * length - middle) / frames
    return int(starts[(clash + off).argmin()])


#: m that one step goes at most, and s that it has at least; most steps of a gap.
STRIDE_M, LEAST_S, MOST = 1.7, 0.22, 12
#: m; steps have time by their length and this.
SHORT_M = 0.4


class Swing(NamedTuple):
    """One foot in the air from `start` to `stop` s."""

    foot: int
    start: float
    stop: float


def planned(
    ways: Sequence[float], up: np.ndarray, seconds: float, first: int, more: tuple[int, int] = (0, 0)
) -> tuple[Swing, ...] | None:
    """The foot of each step and its time, as few steps as there may be; None where two feet cannot walk
    it.

    Args:
        ways: m that either foot must go. up: `(2, 2)` bool, in the air in either keyframe, by foot.
        first: the foot that steps first. more: steps more than it takes, of either foot.
    """
    if bool(up.all(1).any()):
        return None
    need = [
        max(int(np.ceil(way / STRIDE_M)) if way > LEAST_M else 0, int(up[0, k]), int(up[1, k]))
        for k, way in enumerate(ways)
    ]
    # A foot that is in the air at both ends comes down between them, if there is time.
    need = [
        m + 1 if bool(up[:, k].all()) and m < 2 and seconds > 2 * SWING_S else m
        for k, m in enumerate(need)
    ]
    need = [m + x for m, x in zip(need, more, strict=True)]
    for n in range(MOST + 1):
        order = [first if i % 2 == 0 else 1 - first for i in range(n)]
        fits = all(order.count(k) >= need[k] for k in (0, 1))
        starts = not bool(up[0].any()) or (n > 0 and bool(up[0, order[0]]))
        ends = not bool(up[1].any()) or (n > 0 and bool(up[1, order[-1]]))
        if fits and starts and ends:
            return _timed(order, ways, up, seconds)
    return None


def _timed(
    order: list[int], ways: Sequence[float], up: np.ndarray, seconds: float
) -> tuple[Swing, ...] | None:
    n = len(order)
    # A longer step has more of the time, one that is under way in a keyframe about half of it.
    shares = [SHORT_M + ways[k] / order.count(k) for k in order]
    if n and bool(up[0].any()):
        shares[0] *= 0.6
    if n and bool(up[1].any()):
        shares[-1] *= 0.6
    slot = seconds / max(sum(shares), 1e-9)
    if (n and slot * min(shares) < 0.6 * LEAST_S) or seconds < n * LEAST_S:
        return None
    out, at = [], 0.0
    for i, (foot, share) in enumerate(zip(order, shares, strict=True)):
        each = ways[foot] / order.count(foot)
        whole = slot * share
        lasts = min(0.98 * whole, SWING_S + SWING_S_PER_M * each)
        start = at + 0.5 * (whole - lasts)
        if i == 0 and bool(up[0].any()):
            start = 0.0
        if i == n - 1 and bool(up[1].any()):
            start = seconds - lasts
        out.append(Swing(foot, start, start + lasts))
        at += whole
    return tuple(out)


#: m that heels rise, and s before the take-off in which they do.
HEEL_M, HEEL_S = 0.06, 0.12
#: m that the hips go back, for each radian that the trunk leans ahead over them.
TRUNK_M = 0.3
#: m between ankle and toes where a skeleton has none.
SOLE_M = 0.14


def planted(
    skeleton: Skeleton,
    motion: Motion,
    off_floor: tuple[bool, bool],
    lean: np.ndarray,
    falls: tuple[float, float],
    fps: float,
) -> Motion:
    """A gap with its keyframes, from one that stands to one in the air or back: the trunk leans, before
    the flight each foot is where the keyframe has it, and legs bend to follow.

    In the air a foot goes with the root: what it is off its place in the keyframe becomes less, with the
    speed that it has as the heel rises. Landing is the same backwards.

    Args:
        motion: root `(T, 3)` m and rotations `(T, J, 4)` wxyz.
        off_floor: which keyframe is in the air.
        lean: `(T - 2)` rad that the trunk leans ahead. falls: s that each end is in the air.
    """
    try:
        anatomy = find_anatomy(skeleton)
    except PoiseError:
        return motion
    ankles, hips = anatomy.of("foot"), [anatomy.of("thigh", side) for side in ("left", "right")]
    if not ankles or not all(hips) or off_floor[0] == off_floor[1]:
        return motion
    (root, rot), back = motion, off_floor[0]
    pos = skeleton.forward(root, rot)[0]
    stands = -1 if back else 0
    left = (pos[stands, hips[0][0]] - pos[stands, hips[1][0]]) * np.array((1.0, 1.0, 0.0))
    left = left / np.maximum(norm(left), 1e-9)
    facing = np.stack((left[1], -left[0], left[2]))
    root, turned = root.copy(), rot.copy()
    root[1:-1] -= TRUNK_M * np.sin(lean)[:, None] * facing
    leans = axis_angle_to_quat(np.broadcast_to(left, (len(lean), 3)), lean)
    turned[1:-1, 0] = quat_mul(leans, rot[1:-1, 0])
    pos, quat = skeleton.forward(root, turned)
    toes = {skeleton.parents[toe]: toe for _, toe in anatomy.toes}
    goals: dict[int | str, np.ndarray] = {}
    for joint in ankles:
        sole = pos[stands, toes[joint]] - pos[stands, joint] if joint in toes else SOLE_M * facing
        parts = [pos[:, joint], quat[:, joint], root]
        if back:
            parts = [np.flip(x, 0) for x in parts]
        goal, turn = _leaves(*parts, sole, falls[0 if back else 1], fps)
        if back:
            goal, turn = np.flip(goal, 0), np.flip(turn, 0)
        goals[joint] = goal
        turned[:, joint] = quat_between(quat[:, skeleton.parents[joint]], turn)
    out = match_positions(skeleton, turned, root, goals, soft=SOFT)
    # Keyframes stay to the last digit.
    out[[0, -1]] = rot[[0, -1]]
    return root, out


def _leaves(
    ankle: np.ndarray, quat: np.ndarray, root: np.ndarray, sole: np.ndarray, fall: float, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """An ankle's place and rotation, `(T, 3)` and `(T, 4)`, standing in the first frame, with
    its toes at `sole (3,)` m from it, and in the air for the last `fall` s."""
    frames = len(ankle)
    t = (np.arange(frames, dtype=ankle.dtype) - (frames - 1)) / fps + fall
    first = max(0, min(frames - 2, int(np.searchsorted(t, 0.0))))
    # Heels rise by HEEL_M (1 + t / HEEL_S)^2 up to the take-off, where the legs are long.
    up = HEEL_M * np.square(np.maximum(1.0 + np.minimum(t, 0.0) / HEEL_S, 0.0))
    zero = np.zeros_like(up)
    raised = np.stack((zero, zero, up), -1)
    leaves = np.array((0.0, 0.0, 2.0 * HEEL_M / HEEL_S))
    ahead = (root[first + 1] - root[first]) * fps
    u = np.clip(t / max(fall, 1e-6), 0.0, 1.0)[:, None]
    off = hermite(
        u,
        ankle[0] + raised[first] - root[first] + ahead * t[first],
        ankle[-1] - root[-1],
        (leaves - ahead) * fall,
        np.zeros(3, dtype=ankle.dtype),
    )
    place = np.where((t < 0.0)[:, None], ankle[0] + raised, root + off)
    # A heel that rises turns the foot about its toes.
    flat = sole[:2] / np.maximum(norm(sole[:2]), 1e-9)
    axis = np.broadcast_to(np.stack((-flat[1], flat[0], 0.0 * flat[0])), (frames, 3))
    length = max(float(norm(sole)), HEEL_M)
    tilted = quat_mul(axis_angle_to_quat(axis, np.arcsin(up / length)), quat[:1])
    return place, slerp(tilted, np.broadcast_to(quat[-1:], tilted.shape), smoothstep(u[:, 0]))


def hermite(
    u: np.ndarray, start: np.ndarray, stop: np.ndarray, leave: np.ndarray, reach: np.ndarray
) -> np.ndarray:
    """The cubic from `start` to `stop` at `u` from 0 to 1, with its derivatives at both ends."""
    rise = smoothstep(u)
    return start + rise * (stop - start) + u * (1.0 - u) ** 2 * leave - u * u * (1.0 - u) * reach


#: m above where feet stand from which on toes and ankle are in the air.
UP_M = 0.04
#: rad by which a heel rises before a step, s in which it does, and in which a foot gets level; at least.
ROLL, ROLL_S, LEAST_ROLL_S = 0.4, 0.12, 0.08


class Ends(NamedTuple):
    """How feet are in both keyframes: toes `(2, K, 3)` m, rotations `(2, K, 4)` in the world, whether
    each is in the air `(2, K)`, and where the toes of a foot that is level there would be `(2, K, 3)`,
    with its rotation `(2, K, 4)`."""

    toe: np.ndarray
    quat: np.ndarray
    up: np.ndarray
    level_toe: np.ndarray
    level_quat: np.ndarray


class FootPath(NamedTuple):
    """Ankle `(T, 3)` m and rotation `(T, 4)` of a foot, and that which it had if no heel rose."""

    ankle: np.ndarray
    turn: np.ndarray
    flat: np.ndarray


def ends_of(
    pos: np.ndarray, quat: np.ndarray, ankles: Sequence[int], toes: Sequence[int], soles: np.ndarray,
    floor: tuple[float, float],
) -> Ends:  # fmt: skip
    """The feet of both keyframes, `(2, J, 3)` m and `(2, J, 4)`."""
    tip, turn = pos[:, list(toes)], quat[:, list(ankles)]
    off = pos[:, list(ankles), 2] - floor[0], tip[..., 2] - floor[1]
    up = np.minimum(*off) > UP_M
    # A level foot points where it does, with its toes as much under the ankle as those that stand.
    way = tip - pos[:, list(ankles)]
    drop = min(max(floor[0] - floor[1], 0.0), 0.9 * float(norm(soles).min()))
    length = norm(way, keepdims=True)
    flat = normalize(way * np.array((1.0, 1.0, 0.0))) * np.sqrt(np.square(length) - drop**2)
    level = flat - np.array((0.0, 0.0, drop))
    level_quat = quat_mul(shortest_arc(way, level), turn)
    # It gets level about its heel where that stands, about its toes otherwise.
    on_heel = (off[0] < off[1])[..., None]
    level_toe = np.where(on_heel, pos[:, list(ankles)] + level, tip)
    return Ends(tip, turn, up, level_toe, level_quat)


def path_of(
    t: np.ndarray,
    k: int,
    swings: Sequence[Swing],
    ends: Ends,
    sole: np.ndarray,
    leaves: np.ndarray | None,
) -> FootPath:
    """The path of one foot; toes are at `sole (3,)` m in its own frame, which leave at `leaves` m/s."""
    n, seconds = len(swings), float(t[-1])
    up = bool(ends.up[0, k]), bool(ends.up[1, k])
    share = np.arange(n + 1, dtype=t.dtype)[:, None] / max(n, 1)
    places = lerp(ends.level_toe[0, k], ends.level_toe[1, k], share)
    places[:, 2] = np.minimum(places[:, 2], ends.level_toe[:, :, 2].min() + 0.5 * UP_M)
    turns = slerp(
        np.broadcast_to(ends.level_quat[0, k], (n + 1, 4)),
        np.broadcast_to(ends.level_quat[1, k], (n + 1, 4)),
        share[:, 0],
    )
    if up[0]:
        places[0], turns[0] = ends.toe[0, k], ends.quat[0, k]
    if up[1]:
        places[-1], turns[-1] = ends.toe[1, k], ends.quat[1, k]
    if n == 0:
        u = smoothstep(t / max(seconds, 1e-9))[:, None]
        tip = lerp(ends.level_toe[0, k], ends.level_toe[1, k], u)
        turn = slerp(
            np.broadcast_to(ends.level_quat[0, k], (len(t), 4)),
            np.broadcast_to(ends.level_quat[1, k], (len(t), 4)),
            u[:, 0],
        )
    else:
        tip, turn = (
            np.broadcast_to(places[:1], (len(t), 3)).copy(),
            np.broadcast_to(turns[:1], (len(t), 4)).copy(),
        )
    flat = turn
    for i, swing in enumerate(swings):
        if not (i == 0 and up[0]):
            tilt = ROLL * np.square(np.clip(1.0 + (t - swing.start) / ROLL_S, 0.0, 1.0))
            rolled = quat_mul(axis_angle_to_quat(_left(turn, sole), tilt), turn)
            turn = np.where((t <= swing.start)[:, None], rolled, turn)
        lasts = swing.stop - swing.start
        u = np.clip((t - swing.start) / lasts, 0.0, 1.0)
        here, there = places[i], places[i + 1]
        start = np.zeros(3, dtype=t.dtype)
        if i == 0 and up[0] and leaves is not None:
            start = leaves * np.array((1.0, 1.0, 0.0))
        stop = 1.5 * (there - here) if i == n - 1 and up[1] else np.zeros(3, dtype=t.dtype)
        swung = hermite(u[:, None], here, there, start * lasts, stop * np.array((1.0, 1.0, 0.0)))
        clear = CLEAR_M * np.square(np.sin(np.pi * u))
        swung = swung + np.stack((0.0 * clear, 0.0 * clear, clear), -1)
        at_start = turn[int(np.flatnonzero(t <= swing.start + 1e-9)[-1])]
        turned = slerp(
            np.broadcast_to(at_start, (len(t), 4)),
            np.broadcast_to(turns[i + 1], (len(t), 4)),
            smoothstep(u),
        )
        later = (t > swing.start)[:, None]
        tip, turn = np.where(later, swung, tip), np.where(later, turned, turn)
        even = slerp(
            np.broadcast_to(turns[i], (len(t), 4)),
            np.broadcast_to(turns[i + 1], (len(t), 4)),
            smoothstep(u),
        )
        flat = np.where(later, even, flat)
    tip, flat = _from_and_to(t, k, swings, up, ends, tip, flat)
    turn = _from_and_to(t, k, swings, up, ends, tip, turn)[1]
    return FootPath(tip - quat_rotate(turn, np.broadcast_to(sole, tip.shape)), turn, flat)


def _from_and_to(
    t: np.ndarray,
    k: int,
    swings: Sequence[Swing],
    up: tuple[bool, bool],
    ends: Ends,
    tip: np.ndarray,
    turn: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """A foot that stands in a keyframe and is not level there gets level beside it."""
    seconds = float(t[-1])
    for end, since in ((0, t), (1, seconds - t)):
        if up[end]:
            continue
        room = seconds / 2
        if swings:
            room = swings[0].start if end == 0 else seconds - swings[-1].stop
        left = 1.0 - smoothstep(np.clip(since / max(min(ROLL_S, room), LEAST_ROLL_S), 0.0, 1.0))
        tip = tip + left[:, None] * (ends.toe[end, k] - ends.level_toe[end, k])
        turn = slerp(turn, np.broadcast_to(ends.quat[end, k], turn.shape), left)
    return tip, turn


def _left(turn: np.ndarray, sole: np.ndarray) -> np.ndarray:
    """`(T, 3)`, the level axis about which a heel rises; toes are at `sole (3,)` in the foot's frame."""
    way = quat_rotate(turn, np.broadcast_to(sole, (len(turn), 3)))
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0], dtype=way.dtype), way.shape)
    return normalize(cross(up, way))


#: The share of its length that a leg is stretched to, and m that hips come down for it at most.
REACH, DOWN_M = 0.985, 0.2
#: m/s that feet should not be faster than, and what a step more costs, as a share of too much.
FAST, STEP_COST = 6.0, 0.02
#: Plans that are carried out at most.
TRIED = 4


def stepped(
    skeleton: Skeleton,
    motion: Motion,
    floor: tuple[float, float],
    past: Motion | None,
    fps: float,
    over: Callable[[Motion], float],
) -> Motion | None:
    """A gap with its keyframes `(T, ...)`, its feet led by a plan; None where no plan is possible.

    Of several plans it is the first, by `_cost`, that people can do, or the one that asks least.

    Args:
        floor: m, heights of ankles and toes of feet that stand.
        past: the frame before the first keyframe, `(1, ...)`, which says how fast a foot in the air is.
        over: by which factor the fastest joint goes beyond its limit.
    """
    try:
        anatomy = find_anatomy(skeleton)
    except PoiseError:
        return None
    ankles, toes = anatomy.of("foot"), {skeleton.parents[t]: t for _, t in anatomy.toes}
    if len(ankles) != 2 or not all(a in toes for a in ankles):
        return None
    root, rot = motion[0].copy(), motion[1].copy()
    offsets = np.array(skeleton.offsets)
    pos, quat = skeleton.forward(root, rot)
    soles = offsets[[toes[a] for a in ankles]]
    ends = ends_of(pos[[0, -1]], quat[[0, -1]], ankles, [toes[a] for a in ankles], soles, floor)
    seconds = (len(root) - 1) / fps
    ways = [float(norm(w[:2])) for w in ends.level_toe[1] - ends.level_toe[0]]
    past_toes = None
    if past is not None:
        was = skeleton.forward(*past)[0][0]
        past_toes = [(pos[0, toes[a]] - was[toes[a]]) * fps for a in ankles]
    t = np.arange(len(root), dtype=rot.dtype) / fps
    tried: set[tuple[Swing, ...]] = set()
    ways_to_go: list[tuple[float, list[FootPath]]] = []
    for first, *more in product((0, 1), (0, 1), (0, 1)):
        plan = planned(ways, ends.up, seconds, first, (more[0], more[1]))
        if plan is None or plan in tried:
            continue
        tried.add(plan)
        paths = []
        for k in range(2):
            mine = [s for s in plan if s.foot == k]
            leaves = None if past_toes is None else past_toes[k]
            paths.append(path_of(t, k, mine, ends, soles[k], leaves))
        cost = _cost(skeleton, pos, ankles, paths, fps) + STEP_COST * len(plan)
        ways_to_go.append((cost, paths))
    best: tuple[float, Motion] | None = None
    for _, paths in sorted(ways_to_go, key=lambda way: way[0])[:TRIED]:
        done = _walked(skeleton, (root, rot), pos, quat, ankles, toes, paths, fps)
        far = over(done)
        if best is None or far < best[0]:
            best = far, done
        if far <= 1.0:
            break
    return None if best is None else best[1]


def _walked(
    skeleton: Skeleton,
    motion: Motion,
    pos: np.ndarray,
    quat: np.ndarray,
    ankles: Sequence[int],
    toes: Mapping[int, int],
    paths: Sequence[FootPath],
    fps: float,
) -> Motion:
    """The motion with its feet on their paths."""
    root, rot = motion[0], motion[1].copy()
    goals: dict[int | str, np.ndarray] = {}
    for ankle, path in zip(ankles, paths, strict=True):
        goals[ankle] = path.ankle
        rot[:, ankle] = quat_between(quat[:, skeleton.parents[ankle]], path.turn)
        # Toes bend as the heel rises.
        rot[:, toes[ankle]] = quat_mul(quat_between(path.turn, path.flat), rot[:, toes[ankle]])
    root = _lowered(skeleton, root, pos, goals, fps)
    out = match_positions(skeleton, rot, root, goals, soft=SOFT)
    # Keyframes stay to the last digit.
    out[[0, -1]] = motion[1][[0, -1]]
    return root, out


def _cost(
    skeleton: Skeleton, pos: np.ndarray, ankles: Sequence[int], paths: Sequence[FootPath], fps: float
) -> float:
    """How hard a plan is: by how much legs are too short for it, and feet faster than `FAST`."""
    worst = 0.0
    for ankle, path in zip(ankles, paths, strict=True):
        hip, length = _leg(skeleton, pos, ankle)
        stretch = norm(path.ankle - hip).max() / length
        speed = norm(np.diff(path.ankle, axis=0)).max() * fps
        worst += max(0.0, float(stretch) - 1.0) * 5.0 + max(0.0, float(speed) / FAST - 1.0)
    return worst


def _leg(skeleton: Skeleton, pos: np.ndarray, ankle: int) -> tuple[np.ndarray, float]:
    """The hip `(T, 3)` m and the length of a leg."""
    limb = limb_of(skeleton, ankle)
    bones = ((limb.root, limb.mid), (limb.mid, limb.end))
    return pos[:, limb.root], sum(float(norm(pos[0, a] - pos[0, b])) for a, b in bones)


def _lowered(
    skeleton: Skeleton, root: np.ndarray, pos: np.ndarray, goals: dict[int | str, np.ndarray], fps: float
) -> np.ndarray:
    """The root, lower where a leg would not reach its goal."""
    short = np.zeros(len(root), dtype=root.dtype)
    for ankle, goal in goals.items():
        hip, length = _leg(skeleton, pos, skeleton.index(ankle) if isinstance(ankle, str) else ankle)
        off = goal - hip
        tall = np.sqrt(np.maximum((REACH * length) ** 2 - np.square(off[:, :2]).sum(-1), 0.0))
        short = np.maximum(short, -off[:, 2] - tall)
    down = smooth_lift(np.clip(short, 0.0, DOWN_M), fps, 0.5 * ROLL_S)
    t = np.arange(len(root), dtype=root.dtype) / fps
    near = np.clip(np.minimum(t, t[-1] - t) / ROLL_S, 0.0, 1.0)
    out = root.copy()
    out[:, 2] -= down * smoothstep(near)
    return out


def lock_feet(
    skeleton: Skeleton,
    feet: Sequence[int],
    root: np.ndarray,
    rot: np.ndarray,
    contact: np.ndarray,
    free: np.ndarray,
    fps: float,
) -> np.ndarray:
    """Rotations `(T, J, 4)` with the feet held still while they stand; the root's path stays.

    A network may say that a foot stands all through a gap while the keyframes at its ends have the foot
    in two places. Held at both, the foot would slide from one to the other; here it takes a step
    (`missing_steps`). A network averages what it is unsure of, so that a foot that swings hardly leaves
    the floor; here it is raised clear of the floor (`rises`).

    Args:
        feet: joints; ankles with toes among them are held, others left alone.
        root: `(T, 3)` m. rot: `(T, J, 4)` wxyz, local.
        contact: `(T, F)` bool per foot joint. free: `(T)` bool, frames that may change; the others
            (keyframes) say where a foot that stands must be.
    """
    soles, gap = _soles(skeleton, feet), _gap(free)
    if not soles:
        return rot.copy()

    def ends(rot: np.ndarray) -> np.ndarray:
        """`(T, K, 2, 3)` m, ankles and toes in the gap."""
        pos = skeleton.forward(root[gap], rot[gap])[0]
        return pos[:, [[s.ankle, s.toe] for s in soles]]

    def stands() -> np.ndarray:
        """`(T, K)` bool, on either end, in the gap."""
        return np.stack([contact[gap][:, list(s.columns)].any(1) for s in soles], 1)

    if gap is not None:
        contact = contact.copy()
        steps = missing_steps(ends(rot), stands(), fps)
        contact[gap] = stepping(contact[gap], steps, [s.columns for s in soles])
    bears = (contact[1:] & contact[:-1]).astype(rot.dtype) * FIRM

    def standing(pos: np.ndarray, _: np.ndarray) -> dict[int, StandingFoot]:
        return {
            s.ankle: StandingFoot(
                Sole(pos[:, s.ankle], pos[:, [s.ankle, s.toe]]), bears[:, list(s.columns)]
            )
            for s in soles
            if bool(bears[:, list(s.columns)].any())
        }

    rot = hold(skeleton, root, rot, fps, standing, ~free, vertical=True)
    return rot if gap is None else _raised(skeleton, soles, root, rot, rises(ends(rot), stands()), gap)


class _Foot(NamedTuple):
    """An ankle and its toe, and their columns among the contacts."""

    ankle: int
    toe: int
    columns: tuple[int, int]


def _soles(skeleton: Skeleton, feet: Sequence[int]) -> list[_Foot]:
    out = []
    for k, toe in enumerate(feet):
        ankle = skeleton.parents[toe]
        # A leg has a knee and a hip above its ankle.
        if ankle in feet and len(skeleton.ancestors(ankle)) > 2:
            out.append(_Foot(ankle, toe, (list(feet).index(ankle), k)))
    return out


def _gap(free: np.ndarray) -> slice | None:
    """The free frames with the last kept frame before and the first one after them, if there are."""
    inside = np.flatnonzero(free)
    if len(inside) == 0 or inside[0] == 0 or inside[-1] == len(free) - 1:
        return None
    return slice(int(inside[0]) - 1, int(inside[-1]) + 2)


def _raised(
    skeleton: Skeleton, soles: list[_Foot], root: np.ndarray, rot: np.ndarray, up: np.ndarray, gap: slice
) -> np.ndarray:
    """The motion with its feet raised by `up (T, K)` m in the gap."""
    nothing = np.zeros(len(up), dtype=rot.dtype)
    level = np.broadcast_to(np.array([1.0, 0.0, 0.0], dtype=rot.dtype), (len(up), 3))
    leads = {
        sole.ankle: Lead(np.stack((nothing, nothing, up[:, k]), -1), nothing, nothing, level)
        for k, sole in enumerate(soles)
        if bool(up[:, k].any())
    }
    rot = rot.copy()
    if leads:
        rot[gap] = led(skeleton, rot[gap], root[gap], leads)
    return rot
