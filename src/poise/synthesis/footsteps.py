"""Feet led over a gap from the places that its keyframes give them: planted, or in a swing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.kinematics.feet import Sole
from poise.kinematics.hold import FIRM, Lead, StandingFoot, hold, led
from poise.kinematics.limbs import limb_of, match_positions
from poise.motion import Skeleton
from poise.motion.rotations import (
    axis_angle_to_quat,
    forward_kinematics,
    normalize,
    quat_between,
    quat_mul,
    quat_rotate,
    shortest_arc,
    slerp,
)
from poise.motion.smoothing import smooth_lift
from poise.synthesis.limits import Motion, hermite
from poise.synthesis.steps import CLEAR_M, Swing, missing_steps, planned, rises, stepping

#: m above where feet stand from which on toes and ankle are in the air.
UP_M = 0.04
#: rad by which a heel rises before a step, s in which it does, and in which a foot gets level; at least.
ROLL, ROLL_S, LEAST_ROLL_S = 0.4, 0.12, 0.08


class Ends(NamedTuple):
    """How feet are in both keyframes: toes `(2, K, 3)` m, rotations `(2, K, 4)` in the world, whether
    each is in the air `(2, K)`, and where the toes of a foot that is level there would be `(2, K, 3)`,
    with its rotation `(2, K, 4)`."""

    toe: Tensor
    quat: Tensor
    up: Tensor
    level_toe: Tensor
    level_quat: Tensor


class FootPath(NamedTuple):
    """Ankle `(T, 3)` m and rotation `(T, 4)` of a foot, and that which it had if no heel rose."""

    ankle: Tensor
    turn: Tensor
    flat: Tensor


def ends_of(
    pos: Tensor, quat: Tensor, ankles: Sequence[int], toes: Sequence[int], soles: Tensor,
    floor: tuple[float, float],
) -> Ends:  # fmt: skip
    """The feet of both keyframes, `(2, J, 3)` m and `(2, J, 4)`."""
    tip, turn = pos[:, list(toes)], quat[:, list(ankles)]
    off = pos[:, list(ankles), 2] - floor[0], tip[..., 2] - floor[1]
    up = torch.minimum(*off) > UP_M
    # A level foot points where it does, with its toes as much under the ankle as those that stand.
    way = tip - pos[:, list(ankles)]
    drop = min(max(floor[0] - floor[1], 0.0), 0.9 * float(soles.norm(dim=-1).min()))
    length = way.norm(dim=-1, keepdim=True)
    flat = normalize(way * way.new_tensor((1.0, 1.0, 0.0))) * (length.square() - drop**2).sqrt()
    level = flat - way.new_tensor((0.0, 0.0, drop))
    level_quat = quat_mul(shortest_arc(way, level), turn)
    # It gets level about its heel where that stands, about its toes otherwise.
    on_heel = (off[0] < off[1]).unsqueeze(-1)
    level_toe = torch.where(on_heel, pos[:, list(ankles)] + level, tip)
    return Ends(tip, turn, up, level_toe, level_quat)


def path_of(
    t: Tensor, k: int, swings: Sequence[Swing], ends: Ends, sole: Tensor, leaves: Tensor | None
) -> FootPath:
    """The path of one foot; toes are at `sole (3,)` m in its own frame, which leave at `leaves` m/s."""
    n, seconds = len(swings), float(t[-1])
    up = bool(ends.up[0, k]), bool(ends.up[1, k])
    share = torch.arange(n + 1, dtype=t.dtype)[:, None] / max(n, 1)
    places = torch.lerp(ends.level_toe[0, k], ends.level_toe[1, k], share)
    places[:, 2] = torch.minimum(places[:, 2], ends.level_toe[:, :, 2].min() + 0.5 * UP_M)
    turns = slerp(
        ends.level_quat[0, k].expand(n + 1, 4), ends.level_quat[1, k].expand(n + 1, 4), share[:, 0]
    )
    if up[0]:
        places[0], turns[0] = ends.toe[0, k], ends.quat[0, k]
    if up[1]:
        places[-1], turns[-1] = ends.toe[1, k], ends.quat[1, k]
    if n == 0:
        u = smooth(t / max(seconds, 1e-9))[:, None]
        tip = torch.lerp(ends.level_toe[0, k], ends.level_toe[1, k], u)
        turn = slerp(
            ends.level_quat[0, k].expand(len(t), 4), ends.level_quat[1, k].expand(len(t), 4), u[:, 0]
        )
    else:
        tip, turn = places[:1].expand(len(t), 3).clone(), turns[:1].expand(len(t), 4).clone()
    flat = turn
    for i, swing in enumerate(swings):
        if not (i == 0 and up[0]):
            tilt = ROLL * (1.0 + (t - swing.start) / ROLL_S).clamp(0.0, 1.0).square()
            rolled = quat_mul(axis_angle_to_quat(_left(turn, sole), tilt), turn)
            turn = torch.where((t <= swing.start)[:, None], rolled, turn)
        lasts = swing.stop - swing.start
        u = ((t - swing.start) / lasts).clamp(0.0, 1.0)
        here, there = places[i], places[i + 1]
        start = torch.zeros(3, dtype=t.dtype)
        if i == 0 and up[0] and leaves is not None:
            start = leaves * t.new_tensor((1.0, 1.0, 0.0))
        stop = 1.5 * (there - here) if i == n - 1 and up[1] else torch.zeros(3, dtype=t.dtype)
        swung = hermite(u[:, None], here, there, start * lasts, stop * t.new_tensor((1.0, 1.0, 0.0)))
        clear = CLEAR_M * torch.sin(torch.pi * u).square()
        swung = swung + torch.stack((0.0 * clear, 0.0 * clear, clear), -1)
        at_start = turn[int((t <= swing.start + 1e-9).nonzero()[-1])]
        turned = slerp(at_start.expand(len(t), 4), turns[i + 1].expand(len(t), 4), smooth(u))
        later = (t > swing.start)[:, None]
        tip, turn = torch.where(later, swung, tip), torch.where(later, turned, turn)
        even = slerp(turns[i].expand(len(t), 4), turns[i + 1].expand(len(t), 4), smooth(u))
        flat = torch.where(later, even, flat)
    tip, flat = _from_and_to(t, k, swings, up, ends, tip, flat)
    turn = _from_and_to(t, k, swings, up, ends, tip, turn)[1]
    return FootPath(tip - quat_rotate(turn, sole.expand_as(tip)), turn, flat)


def _from_and_to(
    t: Tensor, k: int, swings: Sequence[Swing], up: tuple[bool, bool], ends: Ends, tip: Tensor,
    turn: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """A foot that stands in a keyframe and is not level there gets level beside it."""
    seconds = float(t[-1])
    for end, since in ((0, t), (1, seconds - t)):
        if up[end]:
            continue
        room = seconds / 2
        if swings:
            room = swings[0].start if end == 0 else seconds - swings[-1].stop
        left = 1.0 - smooth((since / max(min(ROLL_S, room), LEAST_ROLL_S)).clamp(0.0, 1.0))
        tip = tip + left[:, None] * (ends.toe[end, k] - ends.level_toe[end, k])
        turn = slerp(turn, ends.quat[end, k].expand_as(turn), left)
    return tip, turn


def _left(turn: Tensor, sole: Tensor) -> Tensor:
    """`(T, 3)`, the level axis about which a heel rises; toes are at `sole (3,)` in the foot's frame."""
    way = quat_rotate(turn, sole.expand(len(turn), 3))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=way.dtype).expand_as(way)
    return normalize(torch.linalg.cross(up, way))


def smooth(u: Tensor) -> Tensor:
    """From 0 to 1, level at both ends."""
    return u * u * (3.0 - 2.0 * u)


#: The share of its length that a leg is stretched to, and m that hips come down for it at most.
REACH, DOWN_M = 0.985, 0.2
#: m/s that feet should not be faster than, and what a step more costs, as a share of too much.
FAST, STEP_COST = 6.0, 0.02
#: Plans that are carried out at most.
TRIED = 4
_SOFT = 0.003


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
    root, rot = motion[0].clone(), motion[1].clone()
    offsets = torch.tensor(np.array(skeleton.offsets), dtype=rot.dtype)
    pos, quat = forward_kinematics(skeleton.parents, offsets, root, rot)
    soles = offsets[[toes[a] for a in ankles]]
    ends = ends_of(pos[[0, -1]], quat[[0, -1]], ankles, [toes[a] for a in ankles], soles, floor)
    seconds = (len(root) - 1) / fps
    ways = [float(w[:2].norm()) for w in ends.level_toe[1] - ends.level_toe[0]]
    past_toes = None
    if past is not None:
        was = forward_kinematics(skeleton.parents, offsets, *past)[0][0]
        past_toes = [(pos[0, toes[a]] - was[toes[a]]) * fps for a in ankles]
    t = torch.arange(len(root), dtype=rot.dtype) / fps
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
    pos: Tensor,
    quat: Tensor,
    ankles: Sequence[int],
    toes: Mapping[int, int],
    paths: Sequence[FootPath],
    fps: float,
) -> Motion:
    """The motion with its feet on their paths."""
    root, rot = motion[0], motion[1].clone()
    goals: dict[int | str, Tensor] = {}
    for ankle, path in zip(ankles, paths, strict=True):
        goals[ankle] = path.ankle
        rot[:, ankle] = quat_between(quat[:, skeleton.parents[ankle]], path.turn)
        # Toes bend as the heel rises.
        rot[:, toes[ankle]] = quat_mul(quat_between(path.turn, path.flat), rot[:, toes[ankle]])
    root = _lowered(skeleton, root, pos, goals, fps)
    out = match_positions(skeleton, rot, root, goals, soft=_SOFT)
    # Keyframes stay to the last digit.
    out[[0, -1]] = motion[1][[0, -1]]
    return root, out


def _cost(
    skeleton: Skeleton, pos: Tensor, ankles: Sequence[int], paths: Sequence[FootPath], fps: float
) -> float:
    """How hard a plan is: by how much legs are too short for it, and feet faster than `FAST`."""
    worst = 0.0
    for ankle, path in zip(ankles, paths, strict=True):
        hip, length = _leg(skeleton, pos, ankle)
        stretch = (path.ankle - hip).norm(dim=-1).amax() / length
        speed = path.ankle.diff(dim=0).norm(dim=-1).amax() * fps
        worst += max(0.0, float(stretch) - 1.0) * 5.0 + max(0.0, float(speed) / FAST - 1.0)
    return worst


def _leg(skeleton: Skeleton, pos: Tensor, ankle: int) -> tuple[Tensor, float]:
    """The hip `(T, 3)` m and the length of a leg."""
    limb = limb_of(skeleton, ankle)
    bones = ((limb.root, limb.mid), (limb.mid, limb.end))
    return pos[:, limb.root], sum(float((pos[0, a] - pos[0, b]).norm()) for a, b in bones)


def _lowered(
    skeleton: Skeleton, root: Tensor, pos: Tensor, goals: dict[int | str, Tensor], fps: float
) -> Tensor:
    """The root, lower where a leg would not reach its goal."""
    short = torch.zeros(len(root), dtype=root.dtype)
    for ankle, goal in goals.items():
        hip, length = _leg(skeleton, pos, skeleton.index(ankle) if isinstance(ankle, str) else ankle)
        off = goal - hip
        tall = ((REACH * length) ** 2 - off[:, :2].square().sum(-1)).clamp_min(0.0).sqrt()
        short = torch.maximum(short, -off[:, 2] - tall)
    down = torch.tensor(smooth_lift(short.clamp(0.0, DOWN_M).numpy(), fps, 0.5 * ROLL_S))
    t = torch.arange(len(root), dtype=root.dtype) / fps
    near = (torch.minimum(t, t[-1] - t) / ROLL_S).clamp(0.0, 1.0)
    out = root.clone()
    out[:, 2] -= down * smooth(near)
    return out


def lock_feet(
    skeleton: Skeleton,
    feet: Sequence[int],
    root: Tensor,
    rot: Tensor,
    contact: Tensor,
    free: Tensor,
    fps: float,
) -> Tensor:
    """Rotations `(T, J, 4)` with the feet held still while they stand; the root's path stays.

    A foot that cannot stand, since the kept frames at both ends have it in other places, takes a step,
    and feet that swing are raised clear of the floor, see `synthesis.steps`.

    Args:
        feet: joints; ankles with toes among them are held, others left alone.
        root: `(T, 3)` m. rot: `(T, J, 4)` wxyz, local.
        contact: `(T, F)` bool per foot joint. free: `(T)` bool, frames that may change; the others
            (keyframes) say where a foot that stands must be.
    """
    soles, gap = _soles(skeleton, feet), _gap(free)
    if not soles:
        return rot.clone()

    def ends(rot: Tensor) -> Tensor:
        """`(T, K, 2, 3)` m, ankles and toes in the gap."""
        offsets = torch.tensor(skeleton.offsets, dtype=rot.dtype)
        pos = forward_kinematics(skeleton.parents, offsets, root[gap], rot[gap])[0]
        return pos[:, [[s.ankle, s.toe] for s in soles]]

    def stands() -> Tensor:
        """`(T, K)` bool, on either end, in the gap."""
        return torch.stack([contact[gap][:, list(s.columns)].any(1) for s in soles], 1)

    if gap is not None:
        contact = contact.clone()
        steps = missing_steps(ends(rot), stands(), fps)
        contact[gap] = stepping(contact[gap], steps, [s.columns for s in soles])
    bears = (contact[1:] & contact[:-1]).to(rot.dtype) * FIRM

    def standing(pos: Tensor, _: Tensor) -> dict[int, StandingFoot]:
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


def _gap(free: Tensor) -> slice | None:
    """The free frames with the last kept frame before and the first one after them, if there are."""
    inside = free.nonzero().squeeze(-1)
    if len(inside) == 0 or inside[0] == 0 or inside[-1] == len(free) - 1:
        return None
    return slice(int(inside[0]) - 1, int(inside[-1]) + 2)


def _raised(
    skeleton: Skeleton, soles: list[_Foot], root: Tensor, rot: Tensor, up: Tensor, gap: slice
) -> Tensor:
    """The motion with its feet raised by `up (T, K)` m in the gap."""
    nothing = torch.zeros(len(up), dtype=rot.dtype)
    level = torch.tensor([1.0, 0.0, 0.0], dtype=rot.dtype).expand(len(up), 3)
    leads = {
        sole.ankle: Lead(torch.stack((nothing, nothing, up[:, k]), -1), nothing, nothing, level)
        for k, sole in enumerate(soles)
        if bool(up[:, k].any())
    }
    rot = rot.clone()
    if leads:
        rot[gap] = led(skeleton, rot[gap], root[gap], leads)
    return rot
