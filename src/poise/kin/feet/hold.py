"""Standing feet that stay where they stand, told from the soles of a body.

A simulated sole creeps, rocks and sinks by millimetres, a captured one slides by centimetres. Where one
bears is told from its height and speed; `feet.lead` then finds the smallest smooth correction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from poise.body import BodyTable
from poise.kin.doctor.support import soles_of
from poise.kin.feet.lead import Sole, lead, led
from poise.kin.ground import smooth_hull
from poise.kin.runs import find_runs
from poise.kin.solids import lowest_height
from poise.metrics.plausibility import CONTACT_RISE, SWING_SPEED
from poise.motion import Clip

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
    first, bears = clip, {}
    for _ in range(ROUNDS):
        clip, bears = _hold_once(clip, table, ground)
    moved = np.linalg.norm(clip.positions() - first.positions(), axis=-1) * 1000
    borne = np.concatenate([moved[when, foot] for foot, when in bears.items()] or [np.zeros(0)])
    most = max((float(moved[:, foot].max()) for foot in bears), default=0.0)
    return clip, Held(float(borne.mean()) if len(borne) else 0.0, most)


def _hold_once(clip: Clip, table: BodyTable, ground: float) -> tuple[Clip, dict[int, np.ndarray]]:
    """The clip with its feet led once, and when `(T)` each foot joint bears."""
    pos, quat = (torch.tensor(x)[:, [r.joint for r in table.rows]] for x in clip.world())
    soles = soles_of(table, pos, quat)
    low = lowest_height(table, pos, quat)
    leads, bears = {}, {}
    weights = _bearing([sole.ends for sole in soles.values()], clip.fps, ground)
    for (row, sole), weight in zip(soles.items(), weights, strict=True):
        weight = weight * ~_dragged(sole, weight, clip.fps)[:, None]
        one = lead(sole, weight.numpy(), clip.fps)
        deep = (ground - low[:, row]).clamp_min(0.0).numpy()
        if deep.any():
            lift = smooth_hull(deep, max(1, round(LIFT_S * clip.fps)), False)
            one.shift[:, 2] = torch.tensor(np.maximum(lift, 0.0))
        foot, steps = table.rows[row].joint, (weight.amax(-1) > 0).numpy()
        leads[foot], bears[foot] = one, np.append(steps, steps[-1])
    root, rot = clip.tensors()
    held = clip.replaced(rot=led(clip.skeleton, rot, root, leads).numpy()) if leads else clip
    return held, bears


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
    for first, last in find_runs(weight.amax(-1).numpy() > 0, 0):
        way = torch.cumsum(path[first : last + 1], 0)
        travel = float((way.amax(0) - way.amin(0)).norm())
        seconds = (last - first + 1) / fps
        out[first : last + 1] = travel > DRAG_M and travel / seconds > DRAG_SPEED
    return out
