"""Feet that stay where they stand: planted spells found, legs bent by two-bone inverse kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from poise.motion.windows import tree_world
from poise.spatial import normalize, quat_conj, quat_mul

#: m; the most a foot is moved, so that a wrong contact cannot tear a leg.
_MOST = 0.12
#: Share of a leg's length that it may be stretched to.
_REACH = 0.999


class Leg(NamedTuple):
    """Joint indices of one leg."""

    hip: int
    knee: int
    ankle: int
    toe: int


def legs_of(parents: Sequence[int], feet: Sequence[int]) -> list[Leg]:
    """The legs above pairs of ankle and toe; a foot without a knee and a hip above it is left out."""
    legs = []
    for ankle in feet:
        toe = next((j for j in feet if parents[j] == ankle), ankle)
        knee = parents[ankle]
        if ankle in (parents[j] for j in feet) and knee > 0 and parents[knee] > 0:
            legs.append(Leg(parents[knee], knee, ankle, toe))
    return legs


def lock_feet(
    parents: Sequence[int],
    feet: Sequence[int],
    offsets: Tensor,
    root: Tensor,
    rot: Tensor,
    contact: Tensor,
    free: Tensor,
    blend: int = 4,
) -> Tensor:
    """Rotations `(T, J, 4)` with the feet held still while they stand; the root's path stays.

    Args:
        offsets `(J, 3)` m, root `(T, 3)` m, rot `(T, J, 4)`.
        contact: `(T, F)` bool per foot joint. free: `(T)` bool, frames that may change; the others
            (keyframes) say where a foot that stands must be.
        blend: frames over which a correction comes and goes.
    """
    pos, quat = tree_world(parents, offsets, root, rot)
    out, index = rot.clone(), {j: k for k, j in enumerate(feet)}
    for leg in legs_of(parents, feet):
        heel, heel_held = _wish(pos[:, leg.ankle], contact[:, index[leg.ankle]], free)
        tip, tip_held = _wish(pos[:, leg.toe], contact[:, index[leg.toe]], free)
        # Where only one end of the foot stands, the whole foot goes along with it.
        held = heel_held | tip_held
        heel, tip = torch.where(heel_held[:, None], heel, tip), torch.where(tip_held[:, None], tip, heel)
        heel, tip = (_limited(_faded(x, held, blend), free) for x in (heel, tip))
        moving = (heel.norm(dim=-1) + tip.norm(dim=-1)) > 1e-9
        if bool(moving.any()):
            goals = pos[:, leg.ankle] + heel, pos[:, leg.toe] + tip
            _bend(leg, parents, pos, quat, goals, out, moving)
    return out


def _wish(path: Tensor, contact: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    """How far a foot joint `(T, 3)` would have to be moved to stand still, and the frames `(T)`."""
    shift, held = torch.zeros_like(path), torch.zeros_like(free)
    for a, b in _spells(contact):
        shift[a:b] = _held(path, a, b, free) - path[a:b]
        held[a:b] = True
    return shift, held


def _limited(shift: Tensor, free: Tensor) -> Tensor:
    size = shift.norm(dim=-1, keepdim=True)
    return shift * (_MOST / size.clamp_min(1e-9)).clamp(max=1.0) * free.to(shift).unsqueeze(-1)


def _spells(flags: Tensor, least: int = 2) -> list[tuple[int, int]]:
    """Runs of true flags as (first, one past the last), at least `least` frames long."""
    padded = torch.cat((flags.new_zeros(1), flags, flags.new_zeros(1))).int()
    edges = torch.diff(padded)
    first, last = (edges == 1).nonzero()[:, 0].tolist(), (edges == -1).nonzero()[:, 0].tolist()
    return [(a, b) for a, b in zip(first, last, strict=True) if b - a >= least]


def _held(path: Tensor, a: int, b: int, free: Tensor) -> Tensor:
    """Where a foot stands during frames a..b-1: at its keyframes' places, on a line between two of
    them, or at its own median."""
    keys = [t for t in range(a, b) if not bool(free[t])]
    if not keys:
        return path[a:b].median(0).values.expand(b - a, 3)
    t = torch.arange(a, b, dtype=path.dtype)
    first, last = path[keys[0]], path[keys[-1]]
    share = ((t - keys[0]) / max(1, keys[-1] - keys[0])).clamp(0, 1).unsqueeze(-1)
    return first + share * (last - first)


def _faded(shift: Tensor, held: Tensor, blend: int) -> Tensor:
    """Corrections that live on beyond their spells, fading over `blend` frames on either side."""
    out = shift.clone()
    known = held.nonzero()[:, 0]
    if not len(known):
        return out
    for t in (~held).nonzero()[:, 0].tolist():
        before, after = known[known < t], known[known > t]
        total = torch.zeros(3, dtype=shift.dtype)
        for side, away in ((before[-1:], t - before[-1:]), (after[:1], after[:1] - t)):
            if len(side) and int(away) <= blend:
                share = 1 - float(away) / (blend + 1)
                total = total + shift[int(side)] * (share * share * (3 - 2 * share))
        out[t] = total
    return out


def _bend(
    leg: Leg, parents: Sequence[int], all_pos: Tensor, all_quat: Tensor, goals: tuple[Tensor, Tensor],
    out: Tensor, rows: Tensor,
) -> None:  # fmt: skip
    """Brings ankles and toes to their goals `(T, 3)` in the frames `rows`: hips and knees turn as two
    bones do, and the foot turns towards where its toe should be."""
    pos, quat = all_pos[rows], all_quat[rows]
    goal, tip = goals[0][rows], goals[1][rows]
    hip, knee, ankle = pos[:, leg.hip], pos[:, leg.knee], pos[:, leg.ankle]
    a, b = (knee - hip).norm(dim=-1), (ankle - knee).norm(dim=-1)
    way = goal - hip
    reach = torch.minimum(way.norm(dim=-1), _REACH * (a + b))
    way = normalize(way)
    # Cosine law: how far along the way to the goal, and how far beside it, the knee stands.
    along = (a * a - b * b + reach * reach) / (2 * reach.clamp_min(1e-6))
    beside = (a * a - along * along).clamp_min(0).sqrt()
    side = knee - hip
    side = normalize(side - (side * way).sum(-1, keepdim=True) * way)
    new_knee = hip + along.unsqueeze(-1) * way + beside.unsqueeze(-1) * side
    new_ankle = hip + reach.unsqueeze(-1) * way
    hip_w = quat_mul(turn_between(knee - hip, new_knee - hip), quat[:, leg.hip])
    knee_w = quat_mul(turn_between(ankle - knee, new_ankle - new_knee), quat[:, leg.knee])
    foot_w = quat[:, leg.ankle]
    if leg.toe != leg.ankle:
        foot_w = quat_mul(turn_between(pos[:, leg.toe] - ankle, tip - new_ankle), foot_w)
    above = quat[:, parents[leg.hip]]
    for joint, parent, own in (
        (leg.hip, above, hip_w), (leg.knee, hip_w, knee_w), (leg.ankle, knee_w, foot_w)
    ):  # fmt: skip
        new = quat_mul(quat_conj(parent), own)
        old = out[rows, joint]
        out[rows, joint] = torch.where((new * old).sum(-1, keepdim=True) < 0, -new, new)


def turn_between(a: Tensor, b: Tensor) -> Tensor:
    """The shortest turn `(..., 4)` that takes the direction of `a (..., 3)` to that of `b`."""
    a, b = normalize(a), normalize(b)
    dot = (a * b).sum(-1, keepdim=True)
    return normalize(torch.cat((1 + dot, torch.linalg.cross(a, b)), -1))
