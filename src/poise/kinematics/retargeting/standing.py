"""A pose in which a skeleton stands, from its rest pose or from its motion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from poise.errors import PoiseError
from poise.kinematics.feet import contact_labels
from poise.motion import Clip, Roles
from poise.motion.clip_info import sampled
from poise.motion.roles import SIDES
from poise.motion.rotations import (
    axis_angle_to_quat,
    matrix_to_quat,
    normalize,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inv,
    shortest_arc,
)
from poise.motion.vectors import cross, lower_median, norm

#: Cosine of the largest angle between a limb and where it hangs in a rest pose that a person could hold.
_LIKE_STANDING = math.cos(math.radians(50))
#: Cosine of the lean up to which a person counts as upright.
_UPRIGHT = math.cos(math.radians(35))
#: A hinge is known when its bends of over `_BENT` (sine) share one axis: length of their mean unit axis.
_BENT, _ONE_AXIS = 0.3, 0.9
#: Frames from which something is known.
_ENOUGH = 5


def pose_positions(roles: Roles, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World positions `(J, 3)` and rotations `(J, 4)` of `local (J, 4)`, the root at the origin."""
    skeleton = roles.skeleton
    zero = np.zeros(3)
    return skeleton.forward(zero, local)


def body_axes(roles: Roles, pos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors `(..., 3)` to the left (hip to hip) and up (hips to shoulders, neck or head)."""

    def of(role: str) -> np.ndarray:
        joint = roles.joint(role)
        assert joint is not None
        return pos[..., joint, :]

    left = of("left_thigh") - of("right_thigh")
    hips = (of("left_thigh") + of("right_thigh")) / 2
    if roles.missing(("left_upper_arm", "right_upper_arm")):
        tops = [*roles.chain("head"), *roles.chain("neck"), *roles.chain("spine")[::-1]]
        if not tops:
            raise PoiseError(
                "the skeleton has neither arms nor spine above its legs", code="facing-unknown"
            )
        top = pos[..., tops[0], :]
    else:
        top = (of("left_upper_arm") + of("right_upper_arm")) / 2
    return normalize(left), normalize(top - hips)


def rest_axes(roles: Roles) -> np.ndarray | None:
    """wxyz that turns the rest pose to stand and face +x, None where no human could stand so."""
    pos = roles.skeleton.rest_positions()
    left, up = body_axes(roles, pos)
    # The nearest axis of the file: a rest pose stands, or lies as a whole.
    axis = np.zeros(3)
    k = int(np.abs(up).argmax())
    axis[k] = 1.0 if up[k] > 0 else -1.0
    lines = [up @ axis]
    for side in SIDES:
        thigh, shin, foot = (pos[roles.joint(f"{side}_{k}") or 0] for k in ("thigh", "shin", "foot"))
        lines += [normalize(shin - thigh) @ -axis, normalize(foot - shin) @ -axis]
    if min(float(x) for x in lines) < _LIKE_STANDING or abs(float(left @ axis)) > 0.3:
        return None
    return facing(left, axis)


def facing(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """wxyz `(..., 4)` that turns `up` onto +z and the part of `left` across it onto +y."""
    y = normalize(left - (left * up).sum(-1, keepdims=True) * up)
    # Rows are the body's axes, so the matrix turns them onto the world's.
    return matrix_to_quat(np.stack((cross(y, up), y, up), -2))


class ClipWorld(NamedTuple):
    """A clip's joints: places `(T, J, 3)` m and rotations `(T, J, 4)` wxyz, world."""

    pos: np.ndarray
    quat: np.ndarray

    @staticmethod
    def of(clip: Clip) -> ClipWorld:
        """The world places and rotations of a clip."""
        return ClipWorld(*(x for x in clip.world()))


def mean_pose(roles: Roles, clip: Clip, world: ClipWorld) -> np.ndarray:
    """`(J, 4)` wxyz local, mean over upright frames; standing upright and facing +x.

    A joint's mean rotation is the principal eigenvector of the sum of q q^T (Markley et al. 2007).
    """
    frames = sampled(clip.frames, 2000)
    pos, quat = world.pos[frames], world.quat[frames]
    left, up = body_axes(roles, pos)
    chosen = up[:, 2] > _UPRIGHT
    if int(chosen.sum()) < max(2, len(frames) // 50):
        # Hardly ever upright: the most upright tenth.
        chosen = up[:, 2] >= np.quantile(up[:, 2], 0.9)
    seen = clip.rot[frames][chosen]
    local = np.stack([_mean(seen[:, j]) for j in range(len(clip.skeleton))])
    hips = roles.joint("hips") or 0
    vertical = np.broadcast_to(np.array([0.0, 0.0, 1.0], dtype=float), (int(chosen.sum()), 3))
    heading = facing(left[chosen], vertical)
    level = _mean(quat_mul(heading, quat[chosen, hips]))
    # The root is turned so that the pelvis stands as it does on average, then that the trunk is upright.
    local[0] = identity()
    rest = pose_positions(roles, local)[1][hips]
    local[0] = quat_mul(level, quat_conj(rest))
    _, lean = body_axes(roles, pose_positions(roles, local)[0])
    local[0] = quat_mul(shortest_arc(lean, vertical[0]), local[0])
    left_now, _ = body_axes(roles, pose_positions(roles, local)[0])
    local[0] = quat_mul(facing(left_now, vertical[0]), local[0])
    return local


def _mean(q: np.ndarray) -> np.ndarray:
    return np.linalg.eigh(q.T @ q)[1][:, -1]


def identity() -> np.ndarray:
    """`(4)` wxyz of no turn."""
    return np.array([1.0, 0.0, 0.0, 0.0], dtype=float)


def hinge_axis(world: ClipWorld, limb: tuple[int, int, int]) -> np.ndarray | None:
    """The unit axis `(3)` about which a knee or elbow bends, in the frame of the bone above it.

    The mean over frames of upper bone x lower bone, where it is bent; None where the limb is hardly ever
    bent or bends about several axes.
    """
    pos, quat = world
    upper, lower = pos[:, limb[1]] - pos[:, limb[0]], pos[:, limb[2]] - pos[:, limb[1]]
    bend = cross(normalize(upper), normalize(lower))
    bent = norm(bend) > _BENT
    if int(bent.sum()) < _ENOUGH:
        return None
    axes = quat_rotate_inv(quat[bent, limb[0]], normalize(bend[bent]))
    mean = axes.mean(0)
    return normalize(mean) if float(norm(mean)) > _ONE_AXIS else None


@dataclass(frozen=True)
class Stances:
    """How feet are turned while they stand.

    rot: per foot joint `(N, 4)` wxyz in the world, the toe turned straight ahead (+x). tilts: `(M)` rad,
    how far the lines from ankle to toe rise in these moments, all feet.
    """

    rot: dict[int, np.ndarray]
    tilts: np.ndarray

    @staticmethod
    def of(world: ClipWorld | None, fps: float, toes: Mapping[int, np.ndarray | None]) -> Stances:
        """The moments in which ankle and toe are low and slow; `toes` in the frames of their feet."""
        rot: dict[int, np.ndarray] = {}
        tilts = [np.zeros(0)]
        for j, toe in toes.items():
            if world is None or toe is None:
                continue
            pos, quat = world.pos[:, j], world.quat[:, j]
            line = quat_rotate(quat, np.broadcast_to(toe, pos.shape))
            points = np.stack((pos, pos + line), 1)
            low = np.quantile(points[..., 2], 0.1, axis=0)
            stands = [
                contact_labels(points[:, [k]], fps, 0.03, ground=float(low[k]))[:, 0] for k in (0, 1)
            ]
            flat = stands[0] & stands[1]
            x, y, z = np.moveaxis(line[flat], -1, 0)
            up = np.broadcast_to(np.array([0.0, 0.0, 1.0], dtype=float), (len(x), 3))
            rot[j] = quat_mul(axis_angle_to_quat(up, -np.arctan2(y, x)), quat[flat])
            tilts.append(np.arctan2(z, np.hypot(x, y)))
        return Stances(rot, np.concatenate(tilts))

    def mean(self, foot: int) -> np.ndarray | None:
        """`(4)` wxyz, the mean rotation of a standing foot, None where it hardly ever stands."""
        seen = self.rot.get(foot)
        return None if seen is None or len(seen) < _ENOUGH else _mean(seen)

    def tilt(self) -> float | None:
        """The median tilt of all standing feet, None where they hardly ever stand."""
        return float(lower_median(self.tilts)) if len(self.tilts) >= _ENOUGH else None
