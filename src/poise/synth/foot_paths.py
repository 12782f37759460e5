"""The path of one foot over a gap: its toes stand, or are in a swing of a plan, and nothing between.

A foot is known by its toes, about which it rolls; between swings they do not move at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from poise.spatial import (
    axis_angle_to_quat,
    normalize,
    quat_mul,
    quat_rotate,
    shortest_arc,
    slerp,
)
from poise.synth.flight import hermite
from poise.synth.step_plans import Swing
from poise.synth.steps import CLEAR_M

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


class Way(NamedTuple):
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
) -> Way:
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
    return Way(tip - quat_rotate(turn, sole.expand_as(tip)), turn, flat)


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
