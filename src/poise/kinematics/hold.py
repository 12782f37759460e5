"""Feet held in place where they stand: one mechanism for every motion, and the path after them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from poise.body import BodyTable
from poise.kinematics.feet import Sole, bearing, dragged, soles_of
from poise.kinematics.forward import lowest_height
from poise.kinematics.limbs import limb_of, match_positions
from poise.kinematics.repair.faults import Fault
from poise.kinematics.repair.support import (
    COMMON_S,
    LEVEL_SPEED,
    RISE_SPEED,
    ROLL_SPEED,
    FloorPoints,
    foot_slips,
    lasting,
    mean_near,
    stance,
)
from poise.motion import Clip, Skeleton
from poise.motion.rotations import (
    axis_angle_to_quat,
    quat_between,
    quat_distance,
    quat_mul,
)
from poise.motion.smoothing import gaussian, smooth_lift, solve_banded
from poise.motion.vectors import cross, sliding

#: A (s) and B (1/s) of `lead`.
SMOOTH_S, RETURN_PER_S = 0.006, 0.6
#: See `limbs.soft_reach`: feet that stand are kept in place by legs that may be nearly straight.
SOFT = 0.003
#: Weight of a frame that must stay as it is; what is left of its correction is set to zero.
_PINNED = 1e8


class Lead(NamedTuple):
    """What is done to a foot: shift `(T, 3)` m of its ankle, turn `(T)` rad about the vertical, tilt
    `(T)` rad that raises its toe, about `axis (T, 3)`, which is level, and roll `(T)` rad about the line
    of the sole, None without any."""

    shift: np.ndarray
    turn: np.ndarray
    tilt: np.ndarray
    axis: np.ndarray
    roll: np.ndarray | None = None


def lead(
    sole: Sole,
    weight: np.ndarray,
    fps: float,
    fixed: np.ndarray | None = None,
    vertical: float = 0.0,
    flat: np.ndarray | None = None,
) -> Lead:
    """How a foot must be led so that its sole does not travel where it bears: a small smooth correction.

    Both ends p of a sole are moved by a shift s of the foot and a turn psi about the vertical:

        min  sum over frames dt [ sum over ends p  w_p |v_p + s' + psi' z x r_p|^2
                                  + A^2 (|s''|^2 + L^2 psi''^2) + B^2 (|s|^2 + L^2 psi^2) ]

    v_p is the horizontal velocity of an end, w_p how much it bears, r_p its place from the ankle and L
    the length of the sole. B leaves slow drifts of long stances where they are, A lets a swinging foot
    go back to its own path without a jerk.

    Args:
        weight: `(T - 1, 2)`, how much each end bears between frames.
        fixed: `(T)` bool, frames that stay as they are.
        vertical: the heights of the ends are held as well, by a shift and a tilt, with this share of
            `weight`.
        flat: `(T - 1)`, how much the ankle stays as well, above the sole, by a roll of the foot.
    """
    fixed = np.zeros(len(sole.ankle), dtype=bool) if fixed is None else fixed
    ends, ankle = sole.ends, sole.ankle
    velocity = np.diff(ends, axis=0) * fps
    length = float(np.linalg.norm(ends[0, 1] - ends[0, 0]))
    arm = (ends - ankle[:, None]) / length
    middle = 0.5 * (arm[1:] + arm[:-1])
    way = ends[:, 1, :2] - ends[:, 0, :2]
    way = way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)
    # Unknowns per frame: s_x, s_y, L psi, and the roll about the sole's line times L.
    rows, width = [], 3 if flat is None else 4
    for p in range(2):
        for axis, across in ((0, -middle[:, p, 1]), (1, middle[:, p, 0])):
            unit = np.zeros((len(velocity), 4))
            unit[:, axis], unit[:, 2] = 1.0, across
            unit[:, 3] = middle[:, p, 2] * (way[1:, 1], -way[1:, 0])[axis]
            unit = unit[:, :width]
            rows.append((np.stack((-unit, unit), 1) * fps, -velocity[:, p, axis], weight[:, p]))
    if flat is not None:
        slip = np.diff(ankle, axis=0) * fps
        for axis in range(2):
            unit = np.tile(np.eye(width)[axis], (len(slip), 1))
            rows.append((np.stack((-unit, unit), 1) * fps, -slip[:, axis], flat))
    level = _solve(rows, width, fixed, fps)
    up = np.zeros((len(ankle), 2))
    if vertical:
        # Unknowns per frame: s_z, L theta.
        along = (middle[..., :2] * 0.5 * (way[1:] + way[:-1])[:, None]).sum(-1)
        heights = []
        for p in range(2):
            unit = np.stack((np.ones(len(along)), along[:, p]), -1)
            held = vertical * weight[:, p]
            heights.append((np.stack((-unit, unit), 1) * fps, -velocity[:, p, 2], held))
        up = _solve(heights, 2, fixed, fps)
    shift = np.concatenate((level[:, :2], up[:, :1]), -1)
    axis = np.stack((way[:, 1], -way[:, 0], np.zeros(len(way))), -1)
    turns = (level[:, 2] / length, up[:, 1] / length, axis, *(level[:, 3:] / length).T)
    return Lead(shift, *turns)


def led(skeleton: Skeleton, rot: np.ndarray, root: np.ndarray, leads: Mapping[int, Lead]) -> np.ndarray:
    """The motion `(T, J, 4)` with the feet (by joint) led, their legs bent to follow, all else kept."""
    pos, quat = skeleton.forward(root, rot)
    goals: dict[int | str, np.ndarray] = {j: pos[:, j] + one.shift for j, one in leads.items()}
    touched = np.zeros(len(rot), dtype=bool)
    for one in leads.values():
        touched |= one.shift.any(-1) | (one.turn != 0) | (one.tilt != 0)
        if one.roll is not None:
            touched |= one.roll != 0
    out = match_positions(skeleton, rot, root, goals, soft=SOFT)
    up = np.array([0.0, 0.0, 1.0], dtype=rot.dtype)
    for joint, one in leads.items():
        # The foot keeps its turn in the world, so its own turn is that of the world seen from it.
        own = quat[:, joint]
        tilt = axis_angle_to_quat(one.axis, one.tilt)
        about = quat_mul(axis_angle_to_quat(up, one.turn), tilt)
        if one.roll is not None:
            line = cross(up, one.axis)
            about = quat_mul(about, axis_angle_to_quat(line, one.roll))
        out[:, joint] = quat_mul(out[:, joint], quat_between(own, quat_mul(about, own)))
    kept = np.ones(rot.shape[:2], dtype=bool)
    for joint in leads:
        kept[:, list(limb_of(skeleton, joint))] = ~touched[:, None]
    return np.where(kept[..., None], rot, out)


Rows = tuple[np.ndarray, np.ndarray, np.ndarray]


def _solve(rows: list[Rows], width: int, fixed: np.ndarray, fps: float) -> np.ndarray:
    """`(T, width)` of least squares with the smoothing terms, zero in the frames `fixed`.

    rows: blocks of `(R, m, width)` coefficients at the frames r to r + m - 1 of row r, what each row
    should give, and its weight.
    """
    frames = len(fixed)
    band, rhs = np.zeros((3 * width, width * frames)), np.zeros(width * frames)
    for block in rows:
        _add(band, rhs, *block)
    for unit in np.eye(width):
        if frames > 2:
            bend = np.tile(np.stack((unit, -2 * unit, unit)) * fps**2, (frames - 2, 1, 1))
            _add(band, rhs, bend, np.zeros(frames - 2), np.full(frames - 2, SMOOTH_S**2))
        back = np.where(fixed, _PINNED, RETURN_PER_S**2)
        _add(band, rhs, np.tile(unit, (frames, 1, 1)), np.zeros(frames), back)
    x = solve_banded(band, rhs[:, None]).reshape(frames, width)
    x[fixed] = 0.0
    return x


def _add(
    band: np.ndarray, rhs: np.ndarray, rows: np.ndarray, want: np.ndarray, weight: np.ndarray
) -> None:
    """Adds `weight |rows x - want|^2` to the normal equations in lower banded form."""
    count, m, width = rows.shape
    flat = rows.reshape(count, width * m)
    at = width * np.arange(count)
    for i in range(width * m):
        np.add.at(rhs, at + i, weight * flat[:, i] * want)
        for j in range(i + 1):
            np.add.at(band[i - j], at + j, weight * flat[:, i] * flat[:, j])


#: How often it is done: a leg that is led back moves its foot a little.
HOLD_ROUNDS = 2
#: How much a foot bears that stands for certain, see `StandingFoot`.
FIRM = 100.0
#: rad/s of a leg's joint above which a foot is rather not held.
FASTEST = 25.0
#: Half the time (s) over which a lift out of the floor is spread.
LIFT_S = 0.05


class StandingFoot(NamedTuple):
    """How a foot stands.

    sole: its points.
    weight: `(T - 1, 2)`, how much either end of the sole bears between frames; from 0 to 1 it may drift
        by millimetres per second, larger numbers hold it firmly.
    lift: `(T)` m, how much higher it must be, None where it stays.
    flat: `(T - 1)`, how much its ankle bears as well, so that it does not roll; None where it may.
    """

    sole: Sole
    weight: np.ndarray
    lift: np.ndarray | None = None
    flat: np.ndarray | None = None


def hold(
    skeleton: Skeleton,
    root: np.ndarray,
    rot: np.ndarray,
    fps: float,
    standing: Callable[[np.ndarray, np.ndarray], Mapping[int, StandingFoot]],
    fixed: np.ndarray | None = None,
    vertical: float = 0.0,
    rounds: int = HOLD_ROUNDS,
) -> np.ndarray:
    """Rotations `(T, J, 4)` wxyz with the feet held where they stand; all but the legs stays as it is.

    Args:
        root: `(T, 3)` m. rot: `(T, J, 4)` wxyz, local.
        standing: tells from world poses `(T, J, 3)` m and `(T, J, 4)` how feet stand, by their joint.
        fixed: `(T)` bool, frames that stay as they are.
        vertical: the heights of the soles' ends are held as well, with this share of their weight.
    """
    for _ in range(rounds):
        leads = {}
        for foot, one in standing(*skeleton.forward(root, rot)).items():
            leads[foot] = lead(one.sole, one.weight, fps, fixed, vertical, one.flat)
            if one.lift is not None:
                leads[foot].shift[:, 2] += one.lift
        rot = led(skeleton, rot, root, leads) if leads else rot
    return rot


@dataclass(frozen=True)
class HoldReport:
    """What holding moved: mm that an ankle was led away from its path, on average over frames in which a
    foot bears and at most; and the feet that were left as they were."""

    mean_mm: float
    max_mm: float
    left: tuple[str, ...] = ()


def hold_feet(clip: Clip, table: BodyTable) -> tuple[Clip, HoldReport]:
    """The clip with its standing feet held, and what that took; all but the legs stays as it is.

    A foot bears where an end of its sole is near the floor and neither rises nor swings (`bearing`).
    Feet that are dragged on purpose are left alone. Soles under the floor are lifted out of it, too. A
    foot is left as it is where its leg would turn faster than joints do, and did not before.

    Args:
        table: the body with the soles; feet without a box have no sole. The floor is at z = 0.
    """
    if clip.frames < 3:
        return clip, HoldReport(0.0, 0.0)
    rows, bears, left = [r.joint for r in table.rows], dict[int, np.ndarray](), set[int]()

    def standing(pos: np.ndarray, quat: np.ndarray) -> dict[int, StandingFoot]:
        pos, quat = pos[:, rows], quat[:, rows]
        soles, low, out = soles_of(table, pos, quat), lowest_height(table, pos, quat), {}
        weights = bearing([sole.ends for sole in soles.values()], clip.fps)
        for (row, sole), weight in zip(soles.items(), weights, strict=True):
            if rows[row] in left:
                continue
            weight = weight * ~dragged(sole, weight, clip.fps)[:, None]
            deep = np.maximum(-low[:, row], 0.0)
            lift = smooth_lift(deep, clip.fps, LIFT_S) if deep.any() else None
            out[rows[row]] = StandingFoot(sole, weight, lift)
            steps = weight.max(-1) > 0
            bears[rows[row]] = np.append(steps, steps[-1])
        return out

    root, rot = clip.arrays()
    out = hold(clip.skeleton, root, rot, clip.fps, standing)
    while fast := _too_fast(clip.skeleton, rot, out, clip.fps, bears):
        left |= fast
        bears.clear()
        out = hold(clip.skeleton, root, rot, clip.fps, standing)
    held = clip.replaced(rot=out) if bears else clip
    moved = np.linalg.norm(held.positions() - clip.positions(), axis=-1) * 1000
    borne = np.concatenate([moved[when, foot] for foot, when in bears.items()] or [np.zeros(0)])
    most = max((float(moved[:, foot].max()) for foot in bears), default=0.0)
    names = tuple(clip.skeleton.names[foot] for foot in sorted(left))
    return held, HoldReport(float(borne.mean()) if len(borne) else 0.0, most, names)


def _too_fast(
    skeleton: Skeleton, before: np.ndarray, after: np.ndarray, fps: float, feet: Iterable[int]
) -> set[int]:
    """Feet with a leg of which a joint turns faster than joints do since it is led."""
    moved = (before != after).any((0, 2))
    fastest = [fps * quat_distance(x[:-1], x[1:]).max(0) for x in (before, after)]
    out = set[int]()
    for foot in feet:
        leg = [j for j in (foot, *skeleton.ancestors(foot)) if moved[j]]
        was, now = (max((float(x[j]) for j in leg), default=0.0) for x in fastest)
        if now > max(FASTEST, was):
            out.add(foot)
    return out


#: What is faster (m/s) swings through, or skates, and is not held.
SWING_SPEED = 1.0


def mend_path(clip: Clip, support: FloorPoints, faults: list[Fault]) -> Clip:
    """The clip with its root path freed of the slip that all standing feet have in common.

    The mean slip of the planted sole points, averaged over time, is taken off the root's horizontal
    velocity wherever feet were found to slide; slower slips than `ROLL_SPEED` stay.
    """
    feet = foot_slips(support)
    # How many feet stand, and the mean of their slips (m/s).
    weight = np.sum([contact for _, _, contact in feet], axis=0).astype(float)
    slip = np.sum([slip for _, slip, _ in feet], axis=0) / np.maximum(weight, 1.0)[:, None]
    if not weight.any() or not faults:
        return clip
    mean = mean_near(slip, weight, clip.fps)[0]
    size = np.linalg.norm(mean, axis=-1, keepdims=True)
    mean = mean * np.maximum(1.0 - ROLL_SPEED / np.maximum(size, 1e-9), 0.0)
    near = np.zeros(clip.frames - 1)
    for fault in faults:
        near[max(fault.start - 1, 0) : fault.stop + 1] = 1.0
    # The correction fades out over the averaging time beside the spells that slide.
    reach = max(1, round(COMMON_S * clip.fps))
    hull = sliding(np.pad(near, reach), 2 * reach + 1).max(-1)
    window = gaussian(0.3 * COMMON_S * clip.fps)
    hull = np.convolve(np.pad(hull, len(window) // 2, mode="edge"), window, "valid")
    path = np.array(clip.root_pos)
    path[1:, :2] -= np.cumsum(mean * hull[:, None], axis=0) / clip.fps
    return clip.replaced(root_pos=path)


def mend_slides(clip: Clip, support: FloorPoints, faults: list[Fault]) -> Clip:
    """The clip with every sliding foot held in place while it stands, its leg bent to follow (`hold`).

    In a spell of `faults` the points of the sole that are in contact bear, see `StandingFoot`, but where
    they swing through.
    """
    speed, contact = support.contacts
    contact, weights = contact & (speed <= SWING_SPEED), {}
    for foot in dict.fromkeys(support.feet):
        mine = [k for k, joint in enumerate(support.feet) if joint == foot]
        slides = np.zeros((clip.frames - 1, 1), dtype=bool)
        for fault in faults:
            if fault.joint == clip.skeleton.names[foot]:
                slides[fault.start : fault.stop] = True
        if bool(slides.any()):
            weights[foot] = mine, (contact[:, mine] & slides).astype(float) * FIRM

    def standing(pos: np.ndarray, _: np.ndarray) -> dict[int, StandingFoot]:
        return {
            foot: StandingFoot(Sole(pos[:, foot], support.soles[:, mine]), weight)
            for foot, (mine, weight) in weights.items()
        }

    root, rot = clip.arrays()
    out = hold(clip.skeleton, root, rot, clip.fps, standing, rounds=1)
    return clip.replaced(rot=out)


#: How surely an end stands that bears: the power of its probability.
SURE = 3
#: How long (s) an end stands at least that rolls as slowly as above.
ROLLS_S = 0.3
#: See `steadied`: how much an end bears, at most, and how that grows.
BEARS, MOST, STEEP = 0.0012, 1.0, 1.5


def steadied(clip: Clip, support: FloorPoints) -> Clip:
    """The clip with its feet held while they stand: as firmly as noise is left in them, no more.

    Feet roll and pivot where they stand. Beyond what they do, q, the speed s is noise: an end bears by
    (s^2 / q^2 - 1) to the power of `STEEP`.
    """
    stands, level, rise = stance(support)
    firm, upright = (float(_firm(s / q)) for s, q in ((level, LEVEL_SPEED), (rise, RISE_SPEED)))
    rolls = np.maximum(ROLLS_S * support.fps / lasting(stands), 1.0)
    weight = _firm(level / (LEVEL_SPEED * rolls)) * stands**SURE
    if firm <= 0.0 or not bool(weight.any()):
        return clip

    def standing(pos: np.ndarray, _: np.ndarray) -> dict[int, StandingFoot]:
        out = dict[int, StandingFoot]()
        for foot in dict.fromkeys(support.feet):
            mine = [k for k, joint in enumerate(support.feet) if joint == foot]
            sole, own = Sole(pos[:, foot], support.soles[:, mine]), weight[:, mine]
            out[foot] = StandingFoot(sole, own, flat=own.min(-1))
        return out

    root, rot = clip.arrays()
    out = hold(clip.skeleton, root, rot, clip.fps, standing, vertical=upright / firm, rounds=1)
    return clip.replaced(rot=out)


def _firm(share: float | np.ndarray) -> np.ndarray:
    """How much an end bears that is so many times as fast as those without noise are."""
    return np.minimum(MOST, BEARS * np.maximum(np.square(share) - 1.0, 0.0) ** STEEP)
