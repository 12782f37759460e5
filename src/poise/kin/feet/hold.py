"""Feet held in place where they stand: one mechanism for every motion.

What says that a foot stands differs: the soles of a body (`hold_feet`), a network (`synth`), the faults
of a recording (`doctor`). All hand in points of the sole and how much they bear (`Standing`); `lead`
finds the smallest smooth correction that keeps them in place, and `led` bends the legs to it.

A simulated sole creeps, rocks and sinks by millimetres, a captured one slides by centimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable
from poise.kin.feet.contact import Sole, bearing, dragged, soles_of
from poise.kin.feet.lead import lead, led
from poise.kin.series import smooth_lift
from poise.kin.solids import lowest_height
from poise.motion import Clip, Skeleton
from poise.spatial import forward_kinematics, quat_distance

#: How often it is done: a leg that is led back moves its foot a little.
HOLD_ROUNDS = 2
#: How much a foot bears that stands for certain, see `Standing`.
FIRM = 100.0
#: rad/s of a leg's joint above which a foot is rather not held.
FASTEST = 25.0
#: Half the time (s) over which a lift out of the floor is spread.
LIFT_S = 0.05


class Standing(NamedTuple):
    """How a foot stands.

    sole: its points.
    weight: `(T - 1, 2)`, how much either end of the sole bears between frames; from 0 to 1 it may drift
        by millimetres per second, larger numbers hold it firmly.
    lift: `(T)` m, how much higher it must be, None where it stays.
    flat: `(T - 1)`, how much its ankle bears as well, so that it does not roll; None where it may.
    """

    sole: Sole
    weight: Tensor
    lift: Tensor | None = None
    flat: Tensor | None = None


def hold(
    skeleton: Skeleton,
    root: Tensor,
    rot: Tensor,
    fps: float,
    standing: Callable[[Tensor, Tensor], Mapping[int, Standing]],
    fixed: Tensor | None = None,
    vertical: float = 0.0,
    rounds: int = HOLD_ROUNDS,
) -> Tensor:
    """Rotations `(T, J, 4)` wxyz with the feet held where they stand; all but the legs stays as it is.

    Args:
        root: `(T, 3)` m. rot: `(T, J, 4)` wxyz, local.
        standing: tells from world poses `(T, J, 3)` m and `(T, J, 4)` how feet stand, by their joint.
        fixed: `(T)` bool, frames that stay as they are.
        vertical: the heights of the soles' ends are held as well, with this share of their weight.
    """
    offsets = torch.tensor(skeleton.offsets, dtype=rot.dtype)
    pinned = None if fixed is None else fixed.numpy()
    for _ in range(rounds):
        leads = {}
        for foot, one in standing(*forward_kinematics(skeleton.parents, offsets, root, rot)).items():
            flat = None if one.flat is None else one.flat.numpy()
            leads[foot] = lead(one.sole, one.weight.numpy(), fps, pinned, vertical, flat)
            if one.lift is not None:
                leads[foot].shift[:, 2] += one.lift
        rot = led(skeleton, rot, root, leads) if leads else rot
    return rot


@dataclass(frozen=True)
class Held:
    """What holding moved: mm that an ankle was led away from its path, on average over frames in which a
    foot bears and at most; and the feet that were left as they were."""

    mean_mm: float
    max_mm: float
    left: tuple[str, ...] = ()


def hold_feet(clip: Clip, table: BodyTable) -> tuple[Clip, Held]:
    """The clip with its standing feet held, and what that took; all but the legs stays as it is.

    A foot bears where an end of its sole is near the floor and neither rises nor swings (`bearing`).
    Feet that are dragged on purpose are left alone. Soles under the floor are lifted out of it, too. A
    foot is left as it is where its leg would turn faster than joints do, and did not before.

    Args:
        table: the body with the soles; feet without a box have no sole. The floor is at z = 0.
    """
    if clip.frames < 3:
        return clip, Held(0.0, 0.0)
    rows, bears, left = [r.joint for r in table.rows], dict[int, np.ndarray](), set[int]()

    def standing(pos: Tensor, quat: Tensor) -> dict[int, Standing]:
        pos, quat = pos[:, rows], quat[:, rows]
        soles, low, out = soles_of(table, pos, quat), lowest_height(table, pos, quat), {}
        weights = bearing([sole.ends for sole in soles.values()], clip.fps)
        for (row, sole), weight in zip(soles.items(), weights, strict=True):
            if rows[row] in left:
                continue
            weight = weight * ~dragged(sole, weight, clip.fps)[:, None]
            deep = (-low[:, row]).clamp_min(0.0).numpy()
            lift = torch.tensor(smooth_lift(deep, clip.fps, LIFT_S)) if deep.any() else None
            out[rows[row]] = Standing(sole, weight, lift)
            steps = (weight.amax(-1) > 0).numpy()
            bears[rows[row]] = np.append(steps, steps[-1])
        return out

    root, rot = clip.tensors()
    out = hold(clip.skeleton, root, rot, clip.fps, standing)
    while fast := _too_fast(clip.skeleton, rot, out, clip.fps, bears):
        left |= fast
        bears.clear()
        out = hold(clip.skeleton, root, rot, clip.fps, standing)
    held = clip.replaced(rot=out.numpy()) if bears else clip
    moved = np.linalg.norm(held.positions() - clip.positions(), axis=-1) * 1000
    borne = np.concatenate([moved[when, foot] for foot, when in bears.items()] or [np.zeros(0)])
    most = max((float(moved[:, foot].max()) for foot in bears), default=0.0)
    names = tuple(clip.skeleton.names[foot] for foot in sorted(left))
    return held, Held(float(borne.mean()) if len(borne) else 0.0, most, names)


def _too_fast(
    skeleton: Skeleton, before: Tensor, after: Tensor, fps: float, feet: Iterable[int]
) -> set[int]:
    """Feet with a leg of which a joint turns faster than joints do since it is led."""
    moved = (before != after).flatten(2).any(-1).any(0)
    fastest = [fps * quat_distance(x[:-1], x[1:]).amax(0) for x in (before, after)]
    out = set[int]()
    for foot in feet:
        leg = [j for j in (foot, *skeleton.ancestors(foot)) if moved[j]]
        was, now = (max((float(x[j]) for j in leg), default=0.0) for x in fastest)
        if now > max(FASTEST, was):
            out.add(foot)
    return out
