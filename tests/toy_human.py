"""A small human made in code, and motions of it, so that tests run without any file."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from poise.motion import Clip, Skeleton
from poise.motion.rotations import euler_to_quat, quat_mul, quat_rotate, rotvec_to_quat, unwrap_quats

#: name, parent, offset from the parent (m) of the middle and the left; the right is mirrored.
_MIDDLE = (("Hips", "", (0, 0, 0)), ("Spine", "Hips", (0, 0, 0.12)), ("Chest", "Spine", (0, 0, 0.2)))
_TOP = (("Neck", "Chest", (0, 0, 0.22)), ("Head", "Neck", (0, 0, 0.1)))
_SIDE = (
    ("UpLeg", "Hips", (0, 0.1, 0)),
    ("Leg", "UpLeg", (0, 0, -0.42)),
    ("Foot", "Leg", (0, 0, -0.4)),
    ("Toe", "Foot", (0.13, 0, -0.05)),
    ("Arm", "Chest", (0, 0.19, 0.16)),
    ("ForeArm", "Arm", (0, 0, -0.28)),
    ("Hand", "ForeArm", (0, 0, -0.26)),
)


@cache
def human(scale: float = 1.0) -> Skeleton:
    """19 joints, facing +x, left is +y, arms hanging; legs of 0.82 m times `scale`."""
    rows = [*_MIDDLE, *_TOP]
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        for name, parent, (x, y, z) in _SIDE:
            above = parent if parent in ("Hips", "Chest") else side + parent
            rows.append((side + name, above, (x, sign * y, z)))
    names = [r[0] for r in rows]
    parents = [names.index(r[1]) if r[1] else -1 for r in rows]
    offsets = np.array([r[2] for r in rows], dtype=float) * scale
    ends = ((names.index("Head"), (0.0, 0.0, 0.12 * scale)),)
    return Skeleton(tuple(names), tuple(parents), offsets, ends)


def turn(axis: str, angle: np.ndarray) -> np.ndarray:
    """wxyz of turns by `angle (T)` rad about one axis letter."""
    return euler_to_quat(angle[..., None], axis)


def swing(
    seconds: float = 1.0,
    fps: float = 30.0,
    speed: float = 0.0,
    bend: float = 0.0,
    cyclic: bool = False,
    name: str = "swing",
    scale: float = 1.0,
) -> Clip:
    """Arms, trunk and legs that swing one whole period.

    speed: m/s forward. bend: rad, how far the path turns to the left by the end.
    """
    skeleton = human(scale)
    frames = round(seconds * fps) + 1
    t = np.linspace(0, 1, frames)
    wave = np.sin(2 * math.pi * t)
    rot = np.zeros((frames, len(skeleton), 4))
    rot[..., 0] = 1.0
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm = quat_mul(turn("Y", -0.5 * sign * wave), turn("X", sign * (0.2 + 0.1 * wave)))
        rot[:, skeleton.index(f"{side}Arm")] = arm
        rot[:, skeleton.index(f"{side}ForeArm")] = turn("Y", -0.4 + 0.2 * sign * wave)
        rot[:, skeleton.index(f"{side}UpLeg")] = turn("Y", 0.1 * sign * wave)
        rot[:, skeleton.index(f"{side}Leg")] = turn("Y", 0.1 + 0.05 * wave)
    rot[:, skeleton.index("Spine")] = turn("Z", 0.1 * wave)
    heading = turn("Z", bend * t)
    rot[:, 0] = quat_mul(heading, turn("X", 0.05 * wave))
    step = np.array([speed / fps, 0.0, 0.0], dtype=float)
    path = np.cumsum(quat_rotate(heading, np.broadcast_to(step, (frames, 3))), 0)
    path = path - path[:1]
    path[:, 2] = 0.9 * scale
    return Clip(skeleton, path, rot, fps, name, cyclic)


def trembling(clip: Clip, rad: float = 0.06, seed: int = 0) -> Clip:
    """The clip with white noise of deviation `rad` about the axes of all its joints."""
    turn = rad * np.random.default_rng(seed).standard_normal((clip.frames, len(clip.skeleton), 3))
    rot = quat_mul(clip.rot, rotvec_to_quat(turn))
    return clip.replaced(rot=unwrap_quats(rot))
