"""Standing feet that stay where they stand, told from the soles of a body.

A simulated sole creeps, rocks and sinks by millimetres, a captured one slides by centimetres. Where one
bears is told from its height and speed; `kin.lead` then finds the smallest smooth correction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from poise.body import BodyTable
from poise.kin.flips import spells
from poise.kin.ground import lowest_height, smooth_hull
from poise.kin.lead import Sole, lead, led
from poise.metrics.plausibility import CONTACT_RISE, SWING_SPEED
from poise.motion import Clip
from poise.spatial import quat_rotate

#: Heights (m) over the floor up to which a sole's end bears wholly, and from which not at all.
BEARS_M, CLEAR_M = 0.015, 0.03
#: A foot that gets this far (m) and is this fast (m/s) on average while it bears is dragged on purpose,
#: or has fallen, and is left alone.
DRAG_M, DRAG_SPEED = 0.15, 0.3
#: Time (s) for which a sole that bears before and after may stop doing so.
GAP_S = 0.07
#: How often it is done: a leg that is led back moves its foot a little.
ROUNDS = 2
#: Half the time (s) over which a lift out of the floor is spread.
LIFT_S = 0.05


@dataclass(frozen=True)
class Held:
    """What holding moved: mm that an ankle was led away from its path, on average over frames in which a
    foot bears and at most."""

    mean_mm: float
    max_mm: float


def hold_feet(clip: Clip, table: BodyTable, ground: float = 0.0) -> tuple[Clip, Held]:
    """The clip with its standing feet held, and what that took; all but the legs stays as it is.

    A foot bears where an end of its sole is near the floor and neither rises nor swings (as in
    `metrics.foot_contacts`). Soles under the floor are lifted out of it, too.

    Args:
        table: the body whose soles they are; feet without a box have no sole.
        ground: height (m) of the floor.
    """
    if clip.frames < 3:
        return clip, Held(0.0, 0.0)
    first, bears = clip, np.zeros((clip.frames, 0), dtype=bool)
    for _ in range(ROUNDS):
        clip, bears = _hold_once(clip, table, ground)
    feet = [r.joint for r in table.rows if r.kind == "foot"][: bears.shape[1]]
    away = np.linalg.norm(clip.positions() - first.positions(), axis=-1)[:, feet] * 1000
    return clip, Held(float(away[bears].mean()) if bears.any() else 0.0, float(away.max(initial=0.0)))


def _hold_once(clip: Clip, table: BodyTable, ground: float) -> tuple[Clip, np.ndarray]:
    """The clip with its feet led once, and which foot bears when `(T, F)`."""
    pos, quat = (torch.tensor(x)[:, [r.joint for r in table.rows]] for x in clip.world())
    soles = _soles_of(table, pos, quat)
    low = lowest_height(table, pos, quat)
    leads, bears = {}, []
    weights = _bearing([sole.ends for sole in soles.values()], clip.fps, ground)
    for (row, sole), weight in zip(soles.items(), weights, strict=True):
        weight = weight * ~_dragged(sole, weight, clip.fps)[:, None]
        one = lead(sole, weight.numpy(), clip.fps)
        deep = (ground - low[:, row]).clamp_min(0.0).numpy()
        if deep.any():
            lift = smooth_hull(deep, max(1, round(LIFT_S * clip.fps)), False)
            one.shift[:, 2] = torch.tensor(np.maximum(lift, 0.0))
        leads[table.rows[row].joint] = one
        bears.append(weight.amax(-1) > 0)
    if not leads:
        return clip, np.zeros((clip.frames, 0), dtype=bool)
    root, rot = clip.tensors()
    steps = torch.stack(bears, -1)
    held = clip.replaced(rot=led(clip.skeleton, rot, root, leads).numpy())
    return held, torch.cat((steps, steps[-1:])).numpy()


def _soles_of(table: BodyTable, pos: Tensor, quat: Tensor) -> dict[int, Sole]:
    """The feet that have a sole, by their row; from poses of the table's rows."""
    out = {}
    for i, row in enumerate(table.rows):
        box = next((g for g in row.geoms if g.kind == "box"), None)
        if row.kind != "foot" or box is None:
            continue
        turn, middle = (torch.tensor(x, dtype=pos.dtype) for x in (box.quat, box.pos))
        ends = []
        for end in (-1.0, 1.0):
            corner = torch.tensor([end * box.size[0], 0.0, -box.size[2]], dtype=pos.dtype)
            local = middle + quat_rotate(turn, corner)
            ends.append(pos[:, i] + quat_rotate(quat[:, i], local.expand_as(pos[:, i])))
        out[i] = Sole(pos[:, i], torch.stack(ends, 1))
    return out


def _bearing(ends: list[Tensor], fps: float, ground: float) -> list[Tensor]:
    """How much the ends `(T, 2, 3)` of each sole bear between frames: `(T - 1, 2)` in [0, 1]."""
    if not ends:
        return []
    points = torch.cat(ends, 1)
    step = torch.diff(points, dim=0) * fps
    height = torch.maximum(points[1:, :, 2], points[:-1, :, 2]) - ground
    near = ((CLEAR_M - height) / (CLEAR_M - BEARS_M)).clamp(0.0, 1.0)
    # The faster a point is, the less it is a standing foot that slips (Tukey's biweight).
    slow = (1.0 - (step[..., :2].norm(dim=-1) / SWING_SPEED).clamp(max=1.0).square()).square()
    bears = near * slow * (step[..., 2].abs() <= CONTACT_RISE)
    # A sole that rocks or bounces for a moment has not left.
    reach = max(1, round(GAP_S * fps / 2))
    wide = functional.max_pool1d(bears.T[None], 2 * reach + 1, 1, reach)
    closed = -functional.max_pool1d(-wide, 2 * reach + 1, 1, reach)[0].T
    return [*torch.maximum(bears, closed * slow * near).split(2, -1)]


def _dragged(sole: Sole, weight: Tensor, fps: float) -> Tensor:
    """Steps `(T - 1)` of spells in which the foot travels over the floor."""
    step = torch.diff(sole.ends[..., :2], dim=0)
    speed = torch.where(weight > 0, step.norm(dim=-1), torch.inf)
    # The end that rests, if one does.
    path = step.gather(1, speed.argmin(-1)[:, None, None].expand(-1, 1, 2))[:, 0]
    out = torch.zeros(len(weight), dtype=torch.bool)
    for first, last in spells(weight.amax(-1).numpy() > 0, 0):
        way = torch.cumsum(path[first : last + 1], 0)
        travel = float((way.amax(0) - way.amin(0)).norm())
        seconds = (last - first + 1) / fps
        out[first : last + 1] = travel > DRAG_M and travel / seconds > DRAG_SPEED
    return out
