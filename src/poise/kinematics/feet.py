"""Feet: when they touch the floor, and with which points; how high they stand, and level soles.

What touches depends on what is asked, so there are four rules; all know a foot by points on it:

- `contact_labels`: which points touch a floor of known height: low and slow.
- `standing_labels`: the same in recordings with different floors and sliding feet.
- `rest_height`, `stance_heights`, `lowest_and_slow`: when feet rest, to tell where the floor is.
- `bearing`: how much either end of a sole bears, to hold it.

`metrics.plausibility.foot_contacts` judges a motion by a rule of its own, and
`synthesis.windows.step_contacts` are the rules of the in-betweening papers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from poise.body import BodyTable, find_anatomy
from poise.body.body_table import BodyRow, Geom
from poise.errors import PoiseError
from poise.kinematics.forward import carried
from poise.metrics.plausibility import CONTACT_RISE, SWING_SPEED
from poise.motion import Clip, Skeleton
from poise.motion.rotations import (
    quat_between,
    quat_conj,
    quat_mul,
    quat_rotate,
    shortest_arc,
)
from poise.motion.smoothing import find_runs
from poise.motion.vectors import lower_median, norm

#: m/s: a point that touches is slower than the first; a whole foot that stands, than the second.
TOUCH_SPEED, STAND_SPEED = 0.35, 0.4
#: Height (m) over the ground under which slow toes and wrists touch it, in retargeting, and under which
#: points of a sole are near it, in examinations (with a floor that is guessed).
TOUCH_M, NEAR_M = {"foot": 0.05, "hand": 0.1}, 0.04
#: Cosine of the tilt up to which a standing sole is level (20 degrees).
LEVEL = 0.94
#: Share of the frames, those in which a foot is lowest, of which the slow ones are taken to stand.
LOWEST_SHARE = 0.3
#: Rests higher than the median by more than this (m) are in the air.
SAME_FLOOR_M = 0.02
#: Heights (m) over the floor up to which a sole's end bears wholly, and from which not at all.
BEARS_M, CLEAR_M = 0.015, 0.03
#: A foot that gets this far (m) and is this fast (m/s) on average while it bears is dragged on purpose,
#: or has fallen.
DRAG_M, DRAG_SPEED = 0.15, 0.3
#: Time (s) for which a sole that bears before and after may stop doing so.
REST_GAP_S = 0.07


#: Root `(T, 3)` m and rotations `(T, J, 4)`.
Motion = tuple[np.ndarray, np.ndarray]


class Sole(NamedTuple):
    """World points of a foot: its ankle `(T, 3)` and the two ends of its sole `(T, 2, 3)`, m."""

    ankle: np.ndarray
    ends: np.ndarray


def sole_boxes(table: BodyTable) -> Iterator[tuple[int, BodyRow, Geom]]:
    """The feet that have a sole: the row's number, the row, and the box that is the sole."""
    for i, row in enumerate(table.rows):
        box = next((g for g in row.geoms if g.kind == "box"), None)
        if row.kind == "foot" and box is not None:
            yield i, row, box


def soles_of(table: BodyTable, pos: np.ndarray, quat: np.ndarray) -> dict[int, Sole]:
    """The soles of a body by their row of the table, from the rows' world poses `(T, B, 3 or 4)`."""
    out = {}
    for i, _, box in sole_boxes(table):
        turn, middle = np.array(box.quat), np.array(box.pos)
        ends = []
        for end in (-1.0, 1.0):
            corner = carried(middle, turn, (end * box.size[0], 0.0, -box.size[2]))
            ends.append(carried(pos[:, i], quat[:, i], corner))
        out[i] = Sole(pos[:, i], np.stack(ends, 1))
    return out


def point_speed(points: np.ndarray, fps: float) -> np.ndarray:
    """`(T, ...)` m/s of points `(T, ..., 3)` m: central differences, one-sided at the ends."""
    at = np.arange(len(points))
    ahead, behind = np.minimum(at + 1, len(points) - 1), np.maximum(at - 1, 0)
    dt = ((ahead - behind).astype(points.dtype) / fps).reshape(-1, *[1] * (points.ndim - 1))
    return norm((points[ahead] - points[behind]) / dt)


def contact_labels(
    points: np.ndarray,
    fps: float,
    height: float = TOUCH_M["foot"],
    speed: float = TOUCH_SPEED,
    ground: float = 0.0,
) -> np.ndarray:
    """Contact `(T, F)` bool of foot points `(T, F, 3)` m: low and slow.

    A point is in contact when it is lower than `height` m above `ground` and moves slower than
    `speed` m/s (central difference). Gaps and spells of a single frame are closed.
    """
    label = (point_speed(points, fps) < speed) & (points[..., 2] < ground + height)
    if len(points) >= 3:
        before, now, after = label[:-2], label[1:-1], label[2:]
        # Majority of three frames.
        middle = (before & now) | (now & after) | (before & after)
        label = np.concatenate((label[:1], middle, label[-1:]), 0)
    return label


def standing_labels(clips: Sequence[np.ndarray], fps: float) -> list[np.ndarray]:
    """Contact `(T, F)` bool of the foot joints `(T, F, 3)` m of each clip, at heights told by the clips.

    Rules that know only steps (`synthesis.windows.step_contacts`) hardly ever find a foot standing in
    recordings with feet that slide by a few centimetres per second. Here a joint's own standing height,
    the lowest tenth of its slow frames in all clips, counts, and per clip within 4 cm below and 6 cm
    above of it, since floors differ; low is what is less than `NEAR_M` above that, slow as in
    `contact_labels`.
    """
    usual = np.stack([_standing(np.concatenate([_slow(c[:, k], fps) for c in clips]))
                         for k in range(clips[0].shape[1])])  # fmt: skip
    out = []
    for points in clips:
        own = np.quantile(points[..., 2], 0.1, axis=0)
        limits = np.clip(own, usual - 0.04, usual + 0.06) + NEAR_M
        # Each joint has a floor of its own.
        lowered = points.copy()
        lowered[..., 2] -= limits
        out.append(contact_labels(lowered, fps, 0.0))
    return out


def _slow(points: np.ndarray, fps: float) -> np.ndarray:
    """Heights of those of the points `(T, 3)` that hardly move to the next frame."""
    moved = norm(np.diff(points, axis=0)) * fps
    return points[1:, 2][moved < TOUCH_SPEED]


def _standing(heights: np.ndarray) -> np.ndarray:
    if not len(heights):
        return np.zeros((), dtype=heights.dtype)
    return np.partition(heights, len(heights) // 10)[len(heights) // 10]


def rest_height(points: np.ndarray, fps: float) -> float:
    """The height (m) of the ground under points of the feet `(T, F, 3)`: the median of those at rest.

    At rest is the lower point of a frame while it moves slower than `TOUCH_SPEED`; without any, the
    tenth percentile of the lowest points counts.
    """
    low, which = points[..., 2].min(-1), points[..., 2].argmin(-1)
    step = norm(np.diff(points, axis=0)) * fps
    speed = np.concatenate((step, step[-1:]))[np.arange(len(low)), which]
    slow = low[speed < TOUCH_SPEED]
    if len(slow) < 5:
        return float(np.quantile(low, 0.1))
    # A foot may rest in the air too; the lower half of the moments of rest is on the floor.
    return float(lower_median(slow[slow <= lower_median(slow) + SAME_FLOOR_M]))


def stance_heights(table: BodyTable, pos: np.ndarray, quat: np.ndarray, fps: float) -> np.ndarray:
    """Heights (m) of the middle of the soles in all frames in which a foot stands.

    A foot stands when its sole is within 20 degrees of level, moves slower than `STAND_SPEED`, and is
    among the lower half of such moments (a foot may also rest level in the air).
    """
    found: list[np.ndarray] = []
    for i, _, box in sole_boxes(table):
        turn = np.array(box.quat)
        up = quat_rotate(turn, np.array([0.0, 0.0, 1.0], dtype=pos.dtype))
        sole = np.array(box.pos) - up * box.size[2]
        point = carried(pos[:, i], quat[:, i], sole)
        level = quat_rotate(quat[:, i], np.broadcast_to(up, pos[:, i].shape))[:, 2] > LEVEL
        found.append(point[level & (point_speed(point, fps) < STAND_SPEED), 2])
    heights = np.concatenate(found) if found else np.zeros(0)
    return heights[heights <= np.median(heights) + SAME_FLOOR_M] if len(heights) else heights


def lowest_and_slow(point: np.ndarray, fps: float) -> np.ndarray:
    """`(T)` bool, when a foot of unknown tilt stands: `point (T, 3)` m is among its lowest and slow."""
    height = point[:, 2]
    low = float(np.quantile(height, LOWEST_SHARE))
    return (height <= low + 1e-9) & (point_speed(point, fps) < STAND_SPEED)


def bearing(ends: list[np.ndarray], fps: float) -> list[np.ndarray]:
    """How much the ends `(T, 2, 3)` of each sole bear on z = 0 between frames: `(T - 1, 2)`, 0 to 1."""
    if not ends:
        return []
    points = np.concatenate(ends, 1)
    step = np.diff(points, axis=0) * fps
    height = np.maximum(points[1:, :, 2], points[:-1, :, 2])
    near = np.clip((CLEAR_M - height) / (CLEAR_M - BEARS_M), 0.0, 1.0)
    # The faster a point is, the less it is a standing foot that slips (Tukey's biweight).
    slow = np.square(1.0 - np.square(np.minimum(norm(step[..., :2]) / SWING_SPEED, 1.0)))
    bears = near * slow * (np.abs(step[..., 2]) <= CONTACT_RISE)
    # A sole that rocks or bounces for a moment has not left.
    reach = max(1, round(REST_GAP_S * fps / 2))
    closed = -_highest(-_highest(bears, reach), reach)
    held = np.maximum(bears, closed * slow * near)
    return [held[:, k : k + 2] for k in range(0, held.shape[1], 2)]


def _highest(values: np.ndarray, reach: int) -> np.ndarray:
    """The largest of `values (T, n)` within `reach` frames."""
    wide = np.pad(values, ((reach, reach), (0, 0)), constant_values=-np.inf)
    return sliding_window_view(wide, 2 * reach + 1, axis=0).max(-1)


def dragged(sole: Sole, weight: np.ndarray, fps: float) -> np.ndarray:
    """Steps `(T - 1)` of spells in which the foot travels over the floor."""
    step = np.diff(sole.ends[..., :2], axis=0)
    speed = np.where(weight > 0, norm(step), np.inf)
    # The end that rests, if one does.
    path = step[np.arange(len(step)), speed.argmin(-1)]
    out = np.zeros(len(weight), dtype=bool)
    for first, last in find_runs(weight.max(-1) > 0, 0):
        way = np.cumsum(path[first : last + 1], 0)
        travel = float(norm(way.max(0) - way.min(0)))
        seconds = (last - first + 1) / fps
        out[first : last + 1] = travel > DRAG_M and travel / seconds > DRAG_SPEED
    return out


#: m under the floor from which on a frame is no longer a foot that sank in.
UNDER_M = 0.1


def joint_heights(skeleton: Skeleton, motion: Motion) -> np.ndarray:
    """`(T, J)` m of all joints."""
    return skeleton.forward(*motion)[0][..., 2]


def off_floor(skeleton: Skeleton, motion: Motion) -> np.ndarray:
    """`(T,)` m, how much higher the lowest joint is than in the frames that stand, of all given."""
    low = joint_heights(skeleton, motion).min(-1)
    return low - np.quantile(low, 0.1)


def standing_heights(skeleton: Skeleton, motion: Motion) -> tuple[float, float]:
    """m, how high the ankle and the toes are of the lower foot, in most frames; 0 without feet."""
    try:
        anatomy = find_anatomy(skeleton)
    except PoiseError:
        return 0.0, 0.0
    ankles, toes = anatomy.of("foot"), [toe for _, toe in anatomy.toes]
    if not ankles or not toes:
        return 0.0, 0.0
    height = joint_heights(skeleton, motion)
    ankle, toe = (float(np.quantile(height[:, list(x)].min(-1), LOWEST_SHARE)) for x in (ankles, toes))
    return ankle, toe


def under_floor(skeleton: Skeleton, motion: Motion) -> np.ndarray:
    """`(T,)` m that the lowest joint lies under the floor at 0; 0 where it does not, or where most
    frames lie as low, since their floor then is elsewhere."""
    low = joint_heights(skeleton, motion).min(-1)
    deep = (low < -UNDER_M) & (low < lower_median(low) - UNDER_M)
    return np.where(deep, -low, np.zeros_like(low))


#: Frames of standing from which something is known.
ENOUGH = 3


def stands_higher(made: Clip, source: Clip, feet: Sequence[int]) -> float | None:
    """By how much (m) the joints `feet` are higher in `made` while they stand in both motions, the
    median; None where they hardly ever do."""
    frames = min(made.frames, source.frames)
    here, there = (c.positions()[:frames][:, list(feet)] for c in (made, source))
    apart: list[float] = []
    for k in range(len(feet)):
        stands = lowest_and_slow(there[:, k], source.fps)
        stands &= point_speed(here[:, k], made.fps) < STAND_SPEED
        apart += (here[:, k] - there[:, k])[stands, 2].tolist()
    return float(lower_median(np.array(apart))) if len(apart) >= ENOUGH else None


#: Frames of standing of which the mean is to be trusted.
ENOUGH_FRAMES = 5
#: Degrees: less is no fault, and more is no foot that stands.
LEAST_DEG, MOST_DEG = 1.0, 35.0


@dataclass(frozen=True, eq=False)
class Levelled:
    """Turns of feet, constant over a clip: joint index to quaternion wxyz in the foot's own frame."""

    turns: Mapping[int, np.ndarray]

    def onto(self, clip: Clip) -> Clip:
        """The clip with its feet turned; what hangs on them stays as it is in the world."""
        return self._turned(clip, self.turns)

    def off(self, clip: Clip) -> Clip:
        """What `onto` did, undone."""
        return self._turned(clip, {j: quat_conj(q) for j, q in self.turns.items()})

    @staticmethod
    def _turned(clip: Clip, turns: Mapping[int, np.ndarray]) -> Clip:
        if not turns:
            return clip
        rot = clip.rot.copy()
        for joint, turn in turns.items():
            rot[:, joint] = quat_mul(rot[:, joint], turn)
            for child in clip.skeleton.children(joint):
                rot[:, child] = quat_between(turn, rot[:, child])
        return clip.replaced(rot=rot)


def level_feet(clip: Clip, table: BodyTable) -> Levelled:
    """The turns with which the table's soles are level on average while the feet of a clip stand.

    A foot stands while it is among the lowest and slow (`lowest_and_slow`). The turn is the shortest
    from the sole's normal to the mean of the vertical, both in the foot's frame.
    """
    pos, quat = (x for x in clip.world())
    up = np.array([0.0, 0.0, 1.0], dtype=pos.dtype)
    turns: dict[int, np.ndarray] = {}
    for _, row, box in sole_boxes(table):
        normal = quat_rotate(np.array(box.quat), up)
        place = carried(pos[:, row.joint], quat[:, row.joint], box.pos)
        stands = lowest_and_slow(place, clip.fps)
        if int(stands.sum()) < ENOUGH_FRAMES:
            continue
        here = quat[stands, row.joint]
        mean = quat_rotate(quat_conj(here), np.broadcast_to(up, (len(here), 3))).mean(0)
        mean = mean / norm(mean)
        angle = float(np.rad2deg(np.arccos(np.clip(normal @ mean, -1.0, 1.0))))
        if LEAST_DEG < angle < MOST_DEG:
            turns[row.joint] = shortest_arc(normal, mean)
    return Levelled(turns)
