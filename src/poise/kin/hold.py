"""Standing feet that stay where they stand: the smallest smooth correction of a whole clip.

A simulated sole creeps, rolls and sinks by millimetres, a captured one slides by centimetres. Both ends
of a sole are moved by a shift s and a turn psi about the vertical such that what bears does not travel:

    min  sum over frames dt [ sum over ends p  w_p |v_p + s' + psi' z x r_p|^2
                              + A^2 (|s''|^2 + L^2 psi''^2) + B^2 (|s|^2 + L^2 psi^2) ]

w_p is how much an end bears, r_p its place from the ankle and L the length of the sole. B leaves slow
drifts of long stances where they are, A lets a swinging foot go back to its own path without a jerk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import solveh_banded
from torch import Tensor
from torch.nn import functional

from poise.body import BodyTable
from poise.kin.flips import spells
from poise.kin.ground import lowest_height, smooth_hull
from poise.kin.limbs import match_positions
from poise.metrics.plausibility import CONTACT_RISE, SWING_SPEED
from poise.motion import Clip
from poise.spatial import axis_angle_to_quat, quat_conj, quat_mul, quat_rotate

#: A (s) and B (1/s) of the module's text.
SMOOTH_S, RETURN_PER_S = 0.006, 0.6
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


@dataclass(frozen=True, eq=False)
class _Sole:
    """One foot: its joint, row of the body table, and world points of its ends `(T, 2, 3)` m."""

    joint: int
    row: int
    ankle: Tensor
    ends: Tensor


def hold_feet(clip: Clip, table: BodyTable, ground: float = 0.0) -> tuple[Clip, Held]:
    """The clip with its standing feet held, and what that took; all but the legs stays as it is.

    A foot bears where an end of its sole is near the floor and neither rises nor swings (as in
    `metrics.foot_contacts`). Soles under the floor are lifted out of it, too.

    Args:
        table: the body whose soles they are; feet without a box have no sole.
        ground: height (m) of the floor.
    """
    first, bears = clip, np.zeros((clip.frames, 0))
    if clip.frames < 3:
        return clip, Held(0.0, 0.0)
    for _ in range(ROUNDS):
        clip, bears = _hold_once(clip, table, ground)
    feet = [r.joint for r in table.rows if r.kind == "foot"]
    away = np.linalg.norm(clip.positions() - first.positions(), axis=-1)[:, feet] * 1000
    borne = away[bears] if bears.shape == away.shape else away
    return clip, Held(float(borne.mean()) if borne.size else 0.0, float(away.max(initial=0.0)))


def _hold_once(clip: Clip, table: BodyTable, ground: float) -> tuple[Clip, np.ndarray]:
    pos, quat = (torch.tensor(x) for x in clip.world())
    soles = _soles_of(table, pos, quat)
    weights = _bearing(torch.cat([s.ends for s in soles], 1), clip.fps, ground) if soles else None
    if weights is None or not bool(weights.any()):
        return clip, np.zeros((clip.frames, 0))
    low = lowest_height(
        table, pos[:, [r.joint for r in table.rows]], quat[:, [r.joint for r in table.rows]]
    )
    targets: dict[int | str, Tensor] = {}
    turns: dict[int, Tensor] = {}
    for k, sole in enumerate(soles):
        mine = weights[:, 2 * k : 2 * k + 2]
        mine *= ~_dragged(sole, mine, clip.fps)[:, None]
        shift, turn = _correction(sole, mine.numpy(), clip.fps)
        deep = (ground - low[:, sole.row]).clamp_min(0.0).numpy()
        lift = np.zeros(clip.frames)
        if deep.any():
            lift = np.maximum(smooth_hull(deep, max(1, round(LIFT_S * clip.fps)), False), 0.0)
        targets[sole.joint] = sole.ankle + torch.tensor(np.concatenate((shift, lift[:, None]), -1))
        turns[sole.joint] = torch.tensor(turn)
    root, rot = clip.tensors()
    out = match_positions(clip.skeleton, rot, root, targets)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=rot.dtype)
    for joint, turn in turns.items():
        # The foot keeps its place in the world, so its own turn is that of the world seen from it.
        own = quat[:, joint]
        about = axis_angle_to_quat(up.expand(len(turn), 3), turn)
        out[:, joint] = quat_mul(out[:, joint], quat_mul(quat_conj(own), quat_mul(about, own)))
    bears = torch.stack([weights[:, 2 * k : 2 * k + 2].amax(-1) > 0 for k in range(len(soles))], -1)
    frames = torch.cat((bears, bears[-1:])).numpy()
    return clip.replaced(rot=out.numpy()), frames


def _soles_of(table: BodyTable, pos: Tensor, quat: Tensor) -> list[_Sole]:
    """The feet that have a sole."""
    out = []
    for i, row in enumerate(table.rows):
        box = next((g for g in row.geoms if g.kind == "box"), None)
        if row.kind != "foot" or box is None:
            continue
        turn, middle = (torch.tensor(x, dtype=pos.dtype) for x in (box.quat, box.pos))
        here, facing, ends = pos[:, row.joint], quat[:, row.joint], []
        for end in (-1.0, 1.0):
            corner = torch.tensor([end * box.size[0], 0.0, -box.size[2]], dtype=pos.dtype)
            local = middle + quat_rotate(turn, corner)
            ends.append(here + quat_rotate(facing, local.expand_as(here)))
        out.append(_Sole(row.joint, i, here, torch.stack(ends, 1)))
    return out


def _bearing(points: Tensor, fps: float, ground: float) -> Tensor:
    """How much each point `(T, P, 3)` bears between frames: `(T - 1, P)` in [0, 1]."""
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
    return torch.maximum(bears, closed * slow * near)


def _dragged(sole: _Sole, weight: Tensor, fps: float) -> Tensor:
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


def _correction(sole: _Sole, weight: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Shift `(T, 2)` m and turn `(T)` rad of a foot; see the module's text."""
    ends, ankle = sole.ends.numpy(), sole.ankle.numpy()
    arm = ends[..., :2] - ankle[:, None, :2]
    length = float(np.linalg.norm(ends[0, 1] - ends[0, 0]))
    frames = len(arm)
    # Unknowns per frame: s_x, s_y, L psi. A row is three coefficients at each of up to three frames.
    band = np.zeros((9, 3 * frames))
    rhs = np.zeros(3 * frames)
    velocity = np.diff(ends[..., :2], axis=0) * fps
    middle = 0.5 * (arm[1:] + arm[:-1]) / length
    for p in range(2):
        w = weight[:, p]
        for axis, across in ((0, -middle[:, p, 1]), (1, middle[:, p, 0])):
            unit = np.zeros((frames - 1, 3))
            unit[:, axis], unit[:, 2] = 1.0, across
            row = np.stack((-unit, unit), 1) * fps
            _add(band, rhs, row, -velocity[:, p, axis], w)
    for k in range(3):
        unit = np.eye(3)[k]
        bend = np.stack((unit, -2 * unit, unit))[None].repeat(frames - 2, 0) * fps**2
        _add(band, rhs, bend, np.zeros(frames - 2), np.full(frames - 2, SMOOTH_S**2))
        _add(
            band, rhs, np.tile(unit, (frames, 1, 1)), np.zeros(frames), np.full(frames, RETURN_PER_S**2)
        )
    x = solveh_banded(band, rhs, lower=True).reshape(frames, 3)
    return x[:, :2], x[:, 2] / length


def _add(
    band: np.ndarray, rhs: np.ndarray, rows: np.ndarray, want: np.ndarray, weight: np.ndarray
) -> None:
    """Adds `weight |rows x - want|^2` to the normal equations in lower banded form.

    rows `(R, m, 3)`: row r has these coefficients at the frames r to r + m - 1.
    """
    count, m, _ = rows.shape
    flat = rows.reshape(count, 3 * m)
    at = 3 * np.arange(count)
    for i in range(3 * m):
        np.add.at(rhs, at + i, weight * flat[:, i] * want)
        for j in range(i + 1):
            np.add.at(band[i - j], at + j, weight * flat[:, i] * flat[:, j])
