"""A clip in one humanoid's generalized coordinates and back; rotations as chains of hinges."""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np

from poise.body import BodyTable, Humanoid
from poise.errors import PoiseError
from poise.motion import Clip, Skeleton
from poise.motion.rotations import (
    euler_to_quat,
    normalize,
    quat_between,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_to_euler,
    quat_to_matrix,
    quat_to_rotvec,
    unwrap_quats,
)
from poise.motion.vectors import lower_median


def chain_quat(angles: np.ndarray, order: str, frame: np.ndarray) -> np.ndarray:
    """Rotation `(..., 4)` of a hinge chain: `frame * R_order(angles) * frame^-1`.

    angles: `(..., n)` rad, outermost hinge first. order: axis letters of `frame`, "" to "ZYX".
    """
    return quat_mul(quat_mul(frame, euler_to_quat(angles, order)), quat_conj(frame))


def chain_angles(
    rot: np.ndarray, order: str, frame: np.ndarray, prefer: np.ndarray | None = None
) -> np.ndarray:
    """Hinge angles `(T, n)` rad of the chain that comes nearest to `rot (T, 4)`, continuous in time.

    Three hinges reproduce any rotation. Of the two Euler branches (a, b, c) and
    (a + pi, pi - b, c + pi) the sequence with the smallest sum of squared steps is found
    (`euler_path`); whole turns are unwrapped, so a pirouette counts up. Two hinges drop the missing
    third angle and one hinge takes the twist about its axis: both exact for rotations that lie in
    the chain. The whole sequence is shifted by full turns to lie nearest `prefer (n)` (default 0).
    """
    local = quat_mul(quat_between(frame, rot), frame)
    if not order:
        return np.zeros((*local.shape[:-1], 0))
    if len(order) == 1:
        axis = 1 + "XYZ".index(order)
        raw = 2.0 * np.arctan2(local[:, axis], local[:, 0])
        path = raw[..., None]
    elif len(order) == 2:
        missing = next(c for c in "XYZ" if c not in order)
        path = quat_to_euler(local, order[0] + missing + order[1])[:, [0, 2]]
    else:
        free = through_lock(quat_to_euler(local, order), order)
        path = euler_path(free[:, None], None if prefer is None else prefer[None])[:, 0]
    path = np.unwrap(path, axis=0)
    centre = np.zeros(len(order), dtype=path.dtype) if prefer is None else prefer
    turns = np.round((lower_median(path, 0) - centre) / (2 * math.pi))
    return path - turns * 2 * math.pi


def through_lock(angles: np.ndarray, order: str) -> np.ndarray:
    """Euler angles `(T, 3)`, the third angle held through frames exactly at gimbal lock.

    There only the sum a +- c is known and `quat_to_euler` sets c to zero, which would be a jump.
    """
    # At b = +-90 degrees R_i(a) R_j(b) R_k(c) = R_i(a +- s c) R_j(b), s the parity of the order.
    locked = (angles[:, 2] == 0.0) & (np.abs(angles[:, 1]) > math.pi / 2 - 1e-6)
    if not bool(locked.any()) or bool(locked.all()):
        return angles
    free = np.flatnonzero(~locked)
    at = np.arange(len(angles))
    # The nearest free frame before, or the first one.
    held = angles[free[np.maximum(np.searchsorted(free, at, side="right") - 1, 0)], 2]
    parity = 1.0 if order in ("XYZ", "YZX", "ZXY") else -1.0
    first = angles[:, 0] - parity * np.sign(angles[:, 1]) * held
    out = angles.copy()
    out[:, 0] = np.where(locked, first, angles[:, 0])
    out[:, 2] = np.where(locked, held, angles[:, 2])
    return out


def within_turns(qpos: np.ndarray, humanoid: Humanoid) -> np.ndarray:
    """`qpos (T, 7 + n)` with hinges that lie outside their ranges shifted by the whole turns that bring
    them nearest. A range may have room for several turns: a hinge that lies in it stays where it is."""
    low, high = humanoid.model.jnt_range[1:].T
    mean = qpos[:, 7:].mean(0)
    turns = np.round((mean - (low + high) / 2) / (2 * np.pi))

    def outside(angle: np.ndarray) -> np.ndarray:
        return np.maximum(np.maximum(low - angle, angle - high), 0.0)

    nearer = outside(mean - 2 * np.pi * turns) < outside(mean)
    out = qpos.copy()
    out[:, 7:] -= 2 * np.pi * np.where(nearer, turns, 0.0)
    return out


def best_path(price: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """The cheaper of two candidates in every frame `(T, R)`, over the whole sequence.

    Args:
        price: `(T - 1, R, 2, 2)`, what the step from candidate i to candidate j costs.
        pull: `(T, R, 2)`, what a candidate costs by itself.

    The sequence of least sum is the shortest path of Viterbi's algorithm. Its costs are products of
    2 x 2 matrices in the algebra of minimum and sum, which is associative, so prefixes and suffixes of
    all frames come in log2(T) passes; a frame takes the candidate through which the best path leads.
    """
    if len(pull) == 1:
        return pull.argmin(-1)
    steps = price + pull[1:, :, None, :]
    first = pull[:1, :, :, None] + np.array([[0.0, np.inf], [np.inf, 0.0]])
    come = _prefix(np.concatenate((first, steps))).min(-2)
    # Suffixes are prefixes of the reversed, transposed steps.
    back = np.swapaxes(steps[::-1], -1, -2)
    go = np.concatenate((_prefix(back).min(-2)[::-1], np.zeros_like(pull[:1])))
    return (come + go).argmin(-1)


def _prefix(m: np.ndarray) -> np.ndarray:
    """All prefix products `(T, R, 2, 2)` in the algebra of minimum and sum (Hillis and Steele 1986)."""
    out, reach = m.copy(), 1
    while reach < len(out):
        a, b = out[:-reach], out[reach:]
        # (a b)_ij = min_k a_ik + b_kj
        joined = np.minimum(
            a[..., :, :1] + b[..., :1, :],
            a[..., :, 1:] + b[..., 1:, :],
        )
        out = np.concatenate((out[:reach], joined))
        reach *= 2
    return out


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles (rad) brought into [-pi, pi)."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def euler_path(first: np.ndarray, prefer: np.ndarray | None = None) -> np.ndarray:
    """Euler angles `(T, R, 3)` on the smoothest sequence through their two branches, not unwrapped.

    The branches (a, b, c) and (a + pi, pi - b, c + pi) are the same rotation. A slight pull toward
    `prefer (R, 3)` (default 0) breaks ties and chooses the branch of a still clip.
    """
    shift = np.array([np.pi, 0.0, np.pi])
    second = first * np.array([1.0, -1.0, 1.0]) + shift + np.array([0.0, np.pi, 0.0])
    both = np.stack((first, second), -2)  # (T, R, 2, 3)
    step = wrapped(both[1:, :, None, :, :] - both[:-1, :, :, None, :])
    home = wrapped(both - (0.0 if prefer is None else prefer[:, None, :]))
    pick = best_path((step**2).sum(-1), 1e-4 * (home**2).sum(-1))
    return np.take_along_axis(both, pick[..., None, None], -2)[..., 0, :]


def clip_to_qpos(clip: Clip, table: BodyTable) -> np.ndarray:
    """`(T, 7 + hinges)`: root position m, root quaternion wxyz, hinge angles rad.

    World rotations of the carried joints are matched exactly where the chain has three hinges; the
    root follows the pelvis. Angles are continuous and may exceed +-pi.
    """
    skeleton, rows = clip.skeleton, table.rows
    if len(skeleton) <= max(r.joint for r in rows) or any(
        skeleton.names[r.joint] != r.name for r in rows
    ):
        raise PoiseError(
            f"its joints ({', '.join(skeleton.names[:6])}, ...) are not those of this character "
            f"({', '.join(r.name for r in rows[:6])}, ...)",
            clip.name,
            code="skeleton-differs",
        )
    pos, quat = clip.world()
    pelvis = rows[0].joint
    columns = [pos[:, pelvis], unwrap_quats(quat[:, pelvis])]
    for row in rows[1:]:
        anchor = rows[row.parent].joint
        rel = quat_between(quat[:, anchor], quat[:, row.joint])
        rest = np.asarray(row.quat, dtype=float)
        rot = quat_between(rest, rel)
        columns.append(chain_angles(rot, row.order, np.asarray(row.frame, dtype=float)))
    return np.concatenate(columns, -1)


class Hinges:
    """A body's coordinates of one frame, its hinges continuous from one frame to the next.

    The twin that knows all frames is `clip_to_qpos`.
    """

    def __init__(self, skeleton: Skeleton, table: BodyTable):
        self.skeleton, self.rows = skeleton, table.rows
        pelvis = self.rows[0].joint
        self._pelvis = (*skeleton.ancestors(pelvis)[::-1], pelvis)
        driven = [r for r in self.rows[1:] if r.order]
        self._joints = np.array([r.joint for r in driven])
        self._anchors = np.array([self.rows[r.parent].joint for r in driven])
        self._rest = np.array([r.quat for r in driven])
        self._frame = np.array([r.frame for r in driven])
        single, euler, column = list[tuple[int, int, int]](), list[tuple[int, ...]](), 0
        for k, row in enumerate(driven):
            n = len(row.order)
            if n == 1:
                single.append((k, "XYZ".index(row.order), column))
            else:
                order = row.order
                if n == 2:
                    order = order[0] + next(c for c in "XYZ" if c not in order) + order[1]
                i, j, l_ = ("XYZ".index(c) for c in order)
                euler.append((k, i, j, l_, column, n))
            column += n
        self._single = np.array(single, dtype=int).reshape(-1, 3).T
        self._two, self._three = (
            np.array([e[:5] for e in euler if e[5] == n], dtype=int).reshape(-1, 5).T for n in (2, 3)
        )
        self.count = column

    def __call__(self, root: np.ndarray, world: np.ndarray, before: np.ndarray | None) -> np.ndarray:
        """`(7 + n)` for the root `(3)` m and the world rotations of all joints.

        before: `(n)` rad, the hinges of the frame before; None takes those nearest to 0.
        """
        out = np.empty(7 + self.count)
        above, below = list(self._pelvis[:-1]), list(self._pelvis[1:])
        out[:3] = root + quat_rotate(world[above], self.skeleton.offsets[below]).sum(0)
        out[3:7] = world[self._pelvis[-1]]
        rel = quat_between(world[self._anchors], world[self._joints])
        local = quat_mul(quat_between(self._frame, quat_between(self._rest, rel)), self._frame)
        m, angles = quat_to_matrix(local), np.zeros(self.count)
        last = np.zeros(self.count) if before is None else before
        k, axis, at = self._single
        angles[at] = 2.0 * np.arctan2(local[k, 1 + axis], local[k, 0])
        a, _, c = _euler(m, *self._two[:4])
        angles[self._two[4]], angles[self._two[4] + 1] = a, c
        at = self._three[4] + np.arange(3)[:, None]
        first = np.stack(_euler(m, *self._three[:4]))
        second = np.stack((first[0] + np.pi, np.pi - first[1], first[2] + np.pi))
        near, far = (np.square(wrapped(x - last[at])).sum(0) for x in (first, second))
        angles[at] = np.where(near <= far, first, second)
        out[7:] = last + wrapped(angles - last)
        return out


def _euler(
    m: np.ndarray, k: np.ndarray, i: np.ndarray, j: np.ndarray, l_: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The angles `(n)` of turns `m[k]` about axes i, then j, then l."""
    e = np.where((j - i) % 3 == 1, 1.0, -1.0)
    b = np.arcsin(np.clip(e * m[k, i, l_], -1.0, 1.0))
    return np.arctan2(-e * m[k, j, l_], m[k, l_, l_]), b, np.arctan2(-e * m[k, i, j], m[k, i, i])


def qpos_to_clip(
    qpos: np.ndarray,
    table: BodyTable,
    skeleton: Skeleton,
    fps: float,
    template: Clip | None = None,
    name: str = "simulated",
) -> Clip:
    """The motion `qpos (T, 7 + hinges)` on `skeleton`, every joint of it.

    Joints without a body of their own (toes, fingers, helpers) and turns that a chain cannot make
    take their local rotation from `template` frame by frame (the clip that was imitated, same frame
    count), or identity without one.
    """
    rows, q = table.rows, np.asarray(qpos, dtype=float)
    frames = len(q)
    if template is None:
        rot = np.zeros((frames, len(skeleton), 4))
        rot[..., 0] = 1.0
    else:
        if template.frames != frames:
            raise PoiseError(
                f"the template has {template.frames} frames and the motion {frames}",
                name,
                code="length-differs",
            )
        rot = template.rot.copy()
    pelvis = rows[0].joint
    # Joints above the pelvis keep their rotation; the pelvis' own takes up the difference.
    above = skeleton.ancestors(pelvis)[::-1]
    world: dict[int, np.ndarray] = {}
    lead = np.zeros((frames, 4))
    lead[:, 0] = 1.0
    shift = np.zeros((frames, 3))
    for j in above:
        if skeleton.parents[j] >= 0:
            shift = shift + quat_rotate(lead, skeleton.offsets[j])
        lead = quat_mul(lead, rot[:, j])
    if above:
        shift = shift + quat_rotate(lead, skeleton.offsets[pelvis])
    root_pos = q[:, :3] - shift
    world[pelvis] = normalize(q[:, 3:7])
    rot[:, pelvis] = quat_between(lead, world[pelvis])
    by_joint = {r.joint: (i, r) for i, r in enumerate(rows)}
    # First column of each row's hinges.
    start = list(accumulate((len(r.order) for r in rows), initial=7))
    for j in range(len(skeleton)):
        parent = skeleton.parents[j]
        if j == pelvis or j in above:
            continue
        if j in by_joint:
            i, row = by_joint[j]
            angles = q[:, start[i] : start[i] + len(row.order)]
            frame = np.asarray(row.frame, dtype=float)
            if row.order:
                rest = np.asarray(row.quat, dtype=float)
                turn = chain_quat(angles, row.order, frame)
                anchor = world[rows[row.parent].joint]
                full = quat_mul(anchor, quat_mul(rest, turn))
                rot[:, j] = quat_between(world[parent], full)
        world[j] = quat_mul(world.get(parent, lead), rot[:, j])
    return Clip(skeleton, root_pos, normalize(rot), fps, name)


def qpos_velocity(qpos: np.ndarray, fps: float) -> np.ndarray:
    """`(T, nv)` velocity of `qpos (T, 7 + n)` in MuJoCo's convention.

    Root linear velocity in the world frame (m/s), root angular velocity in the root's own frame
    (rad/s), hinge speeds (rad/s). Central differences; one-sided at both ends.
    """
    q = np.asarray(qpos, dtype=float)
    frames = len(q)
    ahead = np.minimum(np.arange(frames) + 1, frames - 1)
    behind = np.maximum(np.arange(frames) - 1, 0)
    dt = (ahead - behind).astype(q.dtype)[..., None] / fps
    linear = (q[ahead, :3] - q[behind, :3]) / dt
    # w_b = log(q_behind^-1 q_ahead) / dt, in the root's frame
    turn = quat_to_rotvec(quat_between(q[behind, 3:7], q[ahead, 3:7])) / dt
    hinges = (q[ahead, 7:] - q[behind, 7:]) / dt
    return np.concatenate((linear, turn, hinges), -1)
