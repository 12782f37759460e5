"""Feet led over a gap from the places that its keyframes give them: planted, or in a swing, and nothing
between. For gaps in which feet that the network holds could not be where they must be in time.

A plan (`step_plans`) says which foot swings when, `foot_paths` how it gets there; legs follow here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product

import numpy as np
import torch
from torch import Tensor

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.kin.limbs import limb_of, match_positions
from poise.kin.series import smooth_lift
from poise.motion import Skeleton
from poise.spatial import forward_kinematics, quat_between, quat_mul
from poise.synth.foot_paths import ROLL_S, Way, ends_of, path_of, smooth
from poise.synth.limits import Motion
from poise.synth.step_plans import Swing, planned

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
    ways_to_go: list[tuple[float, list[Way]]] = []
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
    skeleton: Skeleton, motion: Motion, pos: Tensor, quat: Tensor, ankles: Sequence[int],
    toes: Mapping[int, int], paths: Sequence[Way], fps: float,
) -> Motion:  # fmt: skip
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
    skeleton: Skeleton, pos: Tensor, ankles: Sequence[int], paths: Sequence[Way], fps: float
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
