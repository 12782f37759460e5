"""Cyclic clips: the end made to meet the start, repeated, and one period taken out of many."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.errors import PoiseError
from poise.kinematics.coords import qpos_velocity
from poise.kinematics.travel import moved_by
from poise.motion import Clip
from poise.motion.rotations import (
    heading_quat,
    quat_between,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_to_rotvec,
    rotvec_to_quat,
    slerp,
)

#: Angle (rad) between a hinge's first and last frame beyond which a clip is no cycle: a whole turn that
#: joint targets cannot carry on, or a gap so wide that closing it would be another motion.
OPEN = math.pi / 2


@dataclass(frozen=True)
class Cycle:
    """How the end of a cyclic clip met its start.

    gap_deg: the largest angle, of a hinge or of the root's tilt, by which it did not close.
    open_hinge: a hinge that ends more than `OPEN` from where it began; such a clip is played once.
    sunk_m: how far closing it would have pushed the body into the floor, where that was too much; such a
    clip is played once as well.
    """

    gap_deg: float
    open_hinge: str | None = None
    sunk_m: float = 0.0

    @property
    def closed(self) -> bool:
        """Whether the motion goes on from its end to its start."""
        return self.open_hinge is None and self.sunk_m == 0.0

    def sentence(self) -> str:
        """The cycle in words."""
        if self.open_hinge is not None:
            return (
                f"Not repeated, though its file calls it cyclic: {self.open_hinge} ends "
                f"{self.gap_deg:.0f} degrees from where it began."
            )
        if self.sunk_m:
            return (
                f"Not repeated, though its file calls it cyclic: closing a gap of {self.gap_deg:.0f} "
                f"degrees would push it {self.sunk_m * 100:.0f} cm into the floor."
            )
        return f"The cycle did not close by {self.gap_deg:.1f} degrees; the gap was spread over it."


def join_cycle(qpos: np.ndarray, hinges: Sequence[str]) -> tuple[np.ndarray, Cycle]:
    """`close_cycle` where every hinge comes back, else the motion as it is; and what was found.

    Args:
        qpos: `(T, 7 + n)`. hinges: n names.
    """
    apart = np.abs(qpos[-1, 7:] - qpos[0, 7:])
    if len(apart) and apart.max() > OPEN:
        worst = int(apart.argmax())
        return qpos, Cycle(math.degrees(float(apart[worst])), hinges[worst])
    closed, gap_deg = close_cycle(qpos)
    return closed, Cycle(gap_deg)


def close_cycle(qpos: np.ndarray) -> tuple[np.ndarray, float]:
    """A cycle `qpos (T, 7 + n)`, closed: its last frame is its first one cycle later; gap in degrees.

    Frame i takes the share s = i / (T - 1) of the gap: hinges modulo 2 pi, the root's height, and its
    tilt, the orientation without heading. What a cycle adds, heading and horizontal travel, stays. The
    gap is the largest of the hinges' and the tilt's.
    """
    out = np.array(qpos, dtype=np.float64)
    share = np.linspace(0.0, 1.0, len(out))[:, None]
    out[:, 2:3] -= share * (out[-1, 2] - out[0, 2])
    gap = out[-1, 7:] - out[0, 7:]
    gap -= 2 * math.pi * np.round(gap / (2 * math.pi))
    out[:, 7:] -= share * gap
    root = out[:, 3:7]
    ends = root[[0, -1]]
    first, last = quat_between(heading_quat(ends), ends)
    # R_i' = R_i exp(s log(tilt_last^-1 tilt_first)) ends on heading_last tilt_first.
    lean = quat_to_rotvec(quat_between(last, first))
    out[:, 3:7] = quat_mul(root, rotvec_to_quat(share * lean))
    widest = max(float(np.abs(gap).max(initial=0.0)), float(np.linalg.norm(lean)))
    return out, math.degrees(widest)


def cycle_step(qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What one cycle adds: a turn about Z (wxyz), then a horizontal travel (m)."""
    first, last = qpos[0], qpos[-1]
    turn = quat_mul(heading_quat(last[3:7]), quat_conj(heading_quat(first[3:7])))
    travel = last[:3] - quat_rotate(turn, first[:3])
    travel[2] = 0.0
    return turn, travel


def cycle_velocity(qpos: np.ndarray, fps: float) -> np.ndarray:
    """`qpos_velocity` of a closed cycle: the differences at its ends reach across the seam."""
    turn, travel = cycle_step(qpos)
    ahead, behind = qpos[1].copy(), qpos[-2].copy()
    ahead[:3] = quat_rotate(turn, ahead[:3]) + travel
    ahead[3:7] = quat_mul(turn, ahead[3:7])
    behind[:3] = quat_rotate(quat_conj(turn), behind[:3] - travel)
    behind[3:7] = quat_between(turn, behind[3:7])
    return qpos_velocity(np.vstack((behind, qpos, ahead)), fps)[1:-1]


#: The last pose is the first again, or the one before it, within this share of a frame's step and this
#: (m and rad) beside it.
SAME_SHARE, SAME = 0.35, 0.002


def overlap_of(clip: Clip) -> int | None:
    """How many frames of a loop's next period its last one repeats: 1 where it is the first again, 0
    where the first would follow; None of a clip that is no loop.

    Judged by the places of all joints: those of the next frame are those of this one and its step.
    """
    if clip.frames < 4:
        return None
    pos = clip.positions()
    reach = float(np.linalg.norm(np.ptp(pos, axis=0), axis=-1).max())
    step = np.linalg.norm(np.diff(pos[[0, 1, -2, -1]], axis=0), axis=-1)[[0, 2]].max()
    limit = SAME_SHARE * float(step) + SAME
    # What hardly moves closes anyhow.
    if reach < 10 * SAME:
        return None
    if float(np.linalg.norm(pos[-1] - pos[0], axis=-1).max()) <= limit:
        return 1
    ahead = 0.5 * (pos[1] - pos[0] + pos[-1] - pos[-2])
    return 0 if float(np.linalg.norm(pos[-1] + ahead - pos[0], axis=-1).max()) <= limit else None


def repeated(clip: Clip, overlap: int, periods: int) -> Clip:
    """So many periods of a loop, one after another, and the first frame again."""
    at = np.append(np.tile(np.arange(clip.frames - overlap), periods), 0)
    return clip.replaced(root_pos=clip.root_pos[at], rot=clip.rot[at], cyclic=False)


def best_period(clip: Clip, period: int, overlap: int, first: int = 2, stop: int | None = None) -> Clip:
    """The period that closes best of a motion of several, its ends made to meet.

    Frame i of period k is x_k(i). What is given is (1 - s) x_k(i) + s x_{k-1}(i), with s from 0 to 1 as
    smooth as s'' = 0 at its ends: it begins with x_k(0) and ends with x_{k-1}(P) = x_k(0), there with
    the motion's own speed and acceleration. By how much two periods are apart on the ground is taken
    off evenly before, as another speed.

    Args:
        period: frames P. overlap: see `overlap_of`. first: periods before it are not asked, if there
            are others, since the motion begins there. stop: frame from which the motion is lost.
    """
    count = (clip.frames - 1) // period
    end = period + overlap
    if count < 2:
        return clip.replaced(root_pos=clip.root_pos[:end], rot=clip.rot[:end])
    pos = clip.positions()
    pos = pos - pos[:, :1] * np.array([1.0, 1.0, 0.0])
    whole = count if stop is None else min(count, max(2, stop // period))
    asked = range(min(first, whole - 1), whole)

    def apart(k: int) -> float:
        here, before = (pos[j * period : (j + 1) * period + 1] for j in (k, k - 1))
        return float(np.square(here - before).mean())

    k = min(asked, key=apart)
    even = _even(clip, k, period)
    here, before = (np.arange(j * period, (j + 1) * period + 1) for j in (k, k - 1))
    s = np.linspace(0.0, 1.0, period + 1)
    share = s**3 * (10 - 15 * s + 6 * s * s)
    root = even.root_pos[here] * (1 - share[:, None]) + even.root_pos[before] * share[:, None]
    rot = slerp(even.rot[here], even.rot[before], share[:, None])
    return clip.replaced(root_pos=root[:end], rot=rot[:end])


def _even(clip: Clip, k: int, period: int) -> Clip:
    """The clip with the drift from period k - 1 to k, a turn and a way on the ground, taken off evenly
    over time, so that the two lie on each other; frame k P stays where it is."""
    here, before = (slice(j * period, (j + 1) * period + 1) for j in (k, k - 1))
    share = (np.arange(clip.frames) - k * period) / period
    quat = clip.rot[:, 0]
    turned = heading_quat(quat_mul(quat[here], quat_conj(quat[before])))
    angle = -float(2 * np.arctan2(turned[:, 3].sum(), turned[:, 0].sum())) * share
    x, y = clip.root_pos[k * period, :2]
    c, s = np.cos(angle), np.sin(angle)
    stays = np.stack((x - c * x + s * y, y - s * x - c * y, np.zeros(len(angle))), -1)
    clip = moved_by(clip, stays, angle)
    drift = (clip.root_pos[here] - clip.root_pos[before]).mean(0) * np.array([1.0, 1.0, 0.0])
    return clip.replaced(root_pos=clip.root_pos - share[:, None] * drift)


#: A loop may last this share longer or shorter than asked; s in which its end becomes its start; s by
#: which a difference of speeds counts as one of places.
LENIENT, JOINS_S, SPEED_S = 0.1, (0.6, 0.4, 0.9), 0.15
#: Pairs of frames whose loops are compared by their jerk.
PAIRS = 24


def cut_loop(
    clip: Clip, seconds: float, without: Sequence[tuple[float, float]] = ()
) -> tuple[Clip, float]:
    """The part of a long motion of about so many seconds whose end meets its start best, as a cycle.

    Frames i and j are alike where places and speeds of all joints are, seen from the root's heading and
    place on the floor. Up to frame j the motion passes over into that up to frame i, set on its heading
    and place, with a share s as smooth as s'' = 0 at both ends. So the last frame is the first one, a
    turn and a way on the floor later, at the same speed. Of the pairs that are most alike, the first is
    taken whose passage has no more jerk than the rest of its loop, else that with the least in
    proportion.

    Args:
        seconds: of the loop; it may last a tenth longer or shorter.
        without: spans of time, s, of which the loop holds nothing.

    Returns:
        the loop, cyclic; the mean distance of the joints of the two frames, m.

    Raises:
        PoiseError: the motion holds no part that is long enough.
    """
    fps, pos = clip.fps, clip.positions()
    joins, wanted = [max(2, round(s * fps)) for s in JOINS_S], seconds * fps
    near = _from_root(clip, pos)
    speed = np.gradient(near, 1.0 / fps, axis=0) * SPEED_S
    # The root's way on the floor is no difference of places, but one of speeds.
    way = np.gradient(clip.root_pos, 1.0 / fps, axis=0)
    turn = quat_conj(heading_quat(clip.rot[:, 0]))
    speed += (quat_rotate(turn, way) * SPEED_S)[:, None]
    alike = np.concatenate((near, speed), 1).reshape(clip.frames, -1)
    kept = np.ones(clip.frames, dtype=bool)
    for start, stop in without:
        kept[max(0, math.floor(start * fps)) : math.ceil(stop * fps) + 1] = False
    # Frames since the last one that is not to be in it.
    free = np.arange(clip.frames) - np.maximum.accumulate(np.where(kept, -1, np.arange(clip.frames)))
    pairs: list[tuple[float, int, int]] = []
    for length in range(math.ceil((1 - LENIENT) * wanted), math.floor((1 + LENIENT) * wanted) + 1):
        ends = np.flatnonzero(free > length + min(joins))
        if not len(ends) or length <= min(joins):
            continue
        gap = np.square(alike[ends] - alike[ends - length]).mean(1)
        some = gap.argsort(kind="stable")[:PAIRS]
        pairs += [(float(gap[k]), int(ends[k]) - length, int(ends[k])) for k in some]
    if not pairs:
        raise PoiseError(
            f"the motion of {clip.frames / fps:.1f} s holds no {seconds:g} s in a row for a loop",
            clip.name,
            "Make a longer one, or ask for a shorter loop",
            code="clip-too-short",
        )
    best: tuple[float, Clip, float] | None = None
    for _, i, j in sorted(pairs)[:PAIRS]:
        for frames in (k for k in joins if k < min(j - i, free[j] - (j - i))):
            made = _joined(clip, i, j, frames)
            seam = _seam(made, frames)
            if best is None or seam < best[0]:
                best = seam, made, float(np.linalg.norm(near[i] - near[j], axis=-1).mean())
            if seam <= 1.0:
                return made, best[2]
    assert best is not None
    return best[1:]


def _joined(clip: Clip, i: int, j: int, joins: int) -> Clip:
    """Frames i to j as a cycle, the last `joins` of which pass over into those up to frame i."""
    here, before = np.arange(i, j + 1), np.arange(j - joins, j + 1) - (j - i)
    first, last = (clip.rot[k, 0] for k in (i, j))
    onto = quat_mul(heading_quat(last), quat_conj(heading_quat(first)))
    turns = np.broadcast_to(onto, (len(before), 4))
    along = quat_rotate(turns, clip.root_pos[before] - clip.root_pos[i])
    along += clip.root_pos[j] * [1.0, 1.0, 0.0] + clip.root_pos[i] * [0.0, 0.0, 1.0]
    turned = clip.rot[before].copy()
    turned[:, 0] = quat_mul(turns, turned[:, 0])
    s = np.linspace(0.0, 1.0, joins + 1)
    share = (s**3 * (10 - 15 * s + 6 * s * s))[:, None]
    root, rot = clip.root_pos[here].copy(), clip.rot[here].copy()
    tail = slice(-joins - 1, None)
    root[tail] += share * (along - root[tail])
    rot[tail] = slerp(rot[tail], turned, np.broadcast_to(share, rot[tail].shape[:2]))
    return clip.replaced(root_pos=root, rot=rot, cyclic=True)


def _seam(loop: Clip, joins: int) -> float:
    """The mean jerk of a loop's last `joins` frames as a share of that of the others."""
    shake = np.linalg.norm(np.diff(loop.positions(), 3, axis=0), axis=-1).mean(-1)
    return float(shake[-joins:].mean() / max(float(shake[:-joins].mean()), 1e-12))


def _from_root(clip: Clip, pos: np.ndarray) -> np.ndarray:
    """`(T, J, 3)` m, joints seen from below the root, where it faces."""
    turn = quat_conj(heading_quat(clip.rot[:, 0]))[:, None]
    flat = pos - pos[:, :1] * [1.0, 1.0, 0.0]
    return quat_rotate(np.broadcast_to(turn, (*pos.shape[:2], 4)), flat)
