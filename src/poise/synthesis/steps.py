"""Feet that step in a transition: as few steps as there may be, missing ones put in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.kinematics.limbs import match_positions
from poise.motion import Skeleton
from poise.motion.rotations import axis_angle_to_quat, forward_kinematics, quat_between, quat_mul, slerp
from poise.motion.smoothing import find_runs
from poise.synthesis.limits import Flown, Motion, hermite

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


def missing_steps(soles: Tensor, stands: Tensor, fps: float) -> tuple[FootStep, ...]:
    """The steps that must be taken for feet to stand where both ends of a gap have them.

    Args:
        soles: `(T, K, 2, 3)` m, ankles and toes of K feet, the first and last frame being kept ones.
        stands: `(T, K)` bool.

    A foot that stands in all frames and is farther than `LEAST_M` from where it was swings while the
    other feet stand, and as near as can be to when the transition moves it. Of several the one that is
    moved first steps first.
    """
    (frames, feet), ankles = soles.shape[:2], soles[:, :, 0]
    apart = (soles[-1, ..., :2] - soles[0, ..., :2]).norm(dim=-1).amin(-1)
    wanting = [k for k in range(feet) if bool(stands[:, k].all()) and apart[k] > LEAST_M]
    stands = stands.clone()
    found: list[FootStep] = []
    for k in sorted(wanting, key=lambda k: _moved(ankles[:, k])):
        seconds = SWING_S + SWING_S_PER_M * float(apart[k])
        length = round(min(seconds * fps, _MOST_OF_GAP * frames))
        if length < 2 or frames < length + 2 * _EDGE_FRAMES:
            continue
        others = [j for j in range(feet) if j != k]
        later = len(wanting) - len(found) - 1
        start = _when(_moved(ankles[:, k]), ~stands[:, others].all(1), length, later)
        found.append(FootStep(k, start, start + length))
        stands[start : start + length, k] = False
    return tuple(found)


def stepping(stands: Tensor, steps: Sequence[FootStep], columns: Sequence[Sequence[int]]) -> Tensor:
    """Contacts `(T, F)` with the feet of `steps` off the floor; columns: those of every foot."""
    stands = stands.clone()
    for step in steps:
        stands[step.start : step.stop, list(columns[step.foot])] = False
    return stands


def rises(soles: Tensor, stands: Tensor) -> Tensor:
    """`(T, K)` m, how much higher feet must be for each to be `CLEAR_M` clear of the floor in mid-swing.

    Args:
        soles: `(T, K, 2, 3)` m, of a gap with one kept frame at each end.
        stands: `(T, K)` bool.

    The floor is at the lowest place of each end of the foot. Of a swing by more than `LEAST_M` the
    height h(t) above it is to be at least `CLEAR_M sin(pi t)`, by A sin^2(pi t) more.
    """
    height = soles[..., 2] - soles[..., 2].amin(0)
    low, up = height.amin(-1), torch.zeros(stands.shape, dtype=soles.dtype)
    free = ~stands
    free[[0, -1]] = False
    for k in range(stands.shape[1]):
        for first, last in find_runs(free[:, k].numpy(), 0):
            gone = soles[last + 1, k, :, :2] - soles[first - 1, k, :, :2]
            if gone.norm(dim=-1).amin() <= LEAST_M:
                continue
            count = last - first + 1
            t = torch.arange(1, count + 1, dtype=soles.dtype) / (count + 1)
            arc = torch.sin(torch.pi * t)
            short = (CLEAR_M * arc - low[first : last + 1, k]) / arc**2
            inner = (t - 0.5).abs() <= 0.5 * _MIDDLE
            if bool(inner.any()):
                up[first : last + 1, k] = short[inner].amax().clamp(0, CLEAR_M) * arc**2
    return up


def _moved(path: Tensor) -> float:
    """The frame by which half of the way `(T, 3)` is done."""
    way = torch.diff(path[:, :2], dim=0).norm(dim=-1).cumsum(0)
    return float((way < 0.5 * way[-1]).sum())


def _when(middle: float, busy: Tensor, length: int, later: int) -> int:
    """Where a step of `length` frames begins: with little of it while other feet are in the air (`busy`
    `(T)`), room after it for `later` more steps, then near `middle`."""
    frames = len(busy)
    last = max(_EDGE_FRAMES, frames - _EDGE_FRAMES - (later + 1) * length)
    starts = torch.arange(_EDGE_FRAMES, last + 1)
    in_air = torch.cat((torch.zeros(1), busy.double().cumsum(0)))
    clash = in_air[starts + length] - in_air[starts]
    off = (starts + 0.5 * length - middle).abs() / frames
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
    ways: Sequence[float], up: Tensor, seconds: float, first: int, more: tuple[int, int] = (0, 0)
) -> tuple[Swing, ...] | None:
    """Which foot swings when, as few steps as there may be; None where two feet cannot walk it.

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
    order: list[int], ways: Sequence[float], up: Tensor, seconds: float
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
#: See `limbs.soft_reach`.
_SOFT = 0.003


def planted(
    skeleton: Skeleton, motion: Motion, off_floor: tuple[bool, bool], flight: Flown, fps: float
) -> Motion:
    """A gap with its keyframes, from one that stands to one in the air or back: the trunk leans, before
    the flight each foot is where the keyframe has it, and legs bend to follow.

    In the air a foot goes with the root: what it is off its place in the keyframe becomes less, with the
    speed that it has as the heel rises. Landing is the same backwards.

    Args:
        motion: root `(T, 3)` m and rotations `(T, J, 4)` wxyz.
        off_floor: which keyframe is in the air.
        flight: of the frames between.
    """
    try:
        anatomy = find_anatomy(skeleton)
    except PoiseError:
        return motion
    ankles, hips = anatomy.of("foot"), [anatomy.of("thigh", side) for side in ("left", "right")]
    if not ankles or not all(hips) or off_floor[0] == off_floor[1]:
        return motion
    (root, rot), back = motion, off_floor[0]
    offsets = torch.tensor(np.array(skeleton.offsets), dtype=rot.dtype)
    pos = forward_kinematics(skeleton.parents, offsets, root, rot)[0]
    stands = -1 if back else 0
    left = (pos[stands, hips[0][0]] - pos[stands, hips[1][0]]) * root.new_tensor((1.0, 1.0, 0.0))
    left = left / left.norm().clamp_min(1e-9)
    facing = torch.stack((left[1], -left[0], left[2]))
    root, turned = root.clone(), rot.clone()
    root[1:-1] -= TRUNK_M * flight.lean.sin()[:, None] * facing
    lean = axis_angle_to_quat(left.expand(len(flight.lean), 3), flight.lean)
    turned[1:-1, 0] = quat_mul(lean, rot[1:-1, 0])
    pos, quat = forward_kinematics(skeleton.parents, offsets, root, turned)
    toes = {skeleton.parents[toe]: toe for _, toe in anatomy.toes}
    goals: dict[int | str, Tensor] = {}
    for joint in ankles:
        sole = pos[stands, toes[joint]] - pos[stands, joint] if joint in toes else SOLE_M * facing
        parts = [pos[:, joint], quat[:, joint], root]
        if back:
            parts = [x.flip(0) for x in parts]
        goal, turn = _leaves(*parts, sole, flight.falls[0 if back else 1], fps)
        if back:
            goal, turn = goal.flip(0), turn.flip(0)
        goals[joint] = goal
        turned[:, joint] = quat_between(quat[:, skeleton.parents[joint]], turn)
    out = match_positions(skeleton, turned, root, goals, soft=_SOFT)
    # Keyframes stay to the last digit.
    out[[0, -1]] = rot[[0, -1]]
    return root, out


def _leaves(
    ankle: Tensor, quat: Tensor, root: Tensor, sole: Tensor, fall: float, fps: float
) -> tuple[Tensor, Tensor]:
    """Where an ankle is and how it is turned, `(T, 3)` and `(T, 4)`, standing in the first frame, with
    its toes at `sole (3,)` m from it, and in the air for the last `fall` s."""
    frames = len(ankle)
    t = (torch.arange(frames, dtype=ankle.dtype) - (frames - 1)) / fps + fall
    first = max(0, min(frames - 2, int(torch.searchsorted(t, torch.tensor(0.0, dtype=t.dtype)))))
    # Heels rise by HEEL_M (1 + t / HEEL_S)^2 up to the take-off, where the legs are long.
    up = HEEL_M * (1.0 + t.clamp_max(0.0) / HEEL_S).clamp_min(0.0).square()
    zero = torch.zeros_like(up)
    raised = torch.stack((zero, zero, up), -1)
    leaves = raised.new_tensor((0.0, 0.0, 2.0 * HEEL_M / HEEL_S))
    ahead = (root[first + 1] - root[first]) * fps
    u = (t / max(fall, 1e-6)).clamp(0.0, 1.0)[:, None]
    off = hermite(
        u,
        ankle[0] + raised[first] - root[first] + ahead * t[first],
        ankle[-1] - root[-1],
        (leaves - ahead) * fall,
        torch.zeros(3, dtype=ankle.dtype),
    )
    place = torch.where((t < 0.0)[:, None], ankle[0] + raised, root + off)
    # A heel that rises turns the foot about its toes.
    flat = sole[:2] / sole[:2].norm().clamp_min(1e-9)
    axis = torch.stack((-flat[1], flat[0], 0.0 * flat[0])).expand(frames, 3)
    length = max(float(sole.norm()), HEEL_M)
    tilted = quat_mul(axis_angle_to_quat(axis, (up / length).asin()), quat[:1])
    return place, slerp(tilted, quat[-1:].expand_as(tilted), _smooth(u))


def _smooth(u: Tensor) -> Tensor:
    return (u * u * (3.0 - 2.0 * u))[:, 0]
