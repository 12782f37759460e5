"""Feet of a jump: planted while a body crouches, on their toes as it takes off, and along with it in
the air."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.kin.limbs import match_positions
from poise.motion import Skeleton
from poise.spatial import (
    axis_angle_to_quat,
    forward_kinematics,
    quat_between,
    quat_mul,
    slerp,
)
from poise.synth.flight import Flown, hermite
from poise.synth.limits import Motion

#: m that heels rise, and s before the take-off in which they do.
HEEL_M, HEEL_S = 0.06, 0.12
#: m that the hips go back, for each radian that the trunk leans ahead over them.
TRUNK_M = 0.3
#: m between ankle and toes where a skeleton has none.
SOLE_M = 0.14
#: See `limbs.soft_reach`.
_SOFT = 0.003


def planted(
    skeleton: Skeleton, motion: Motion, off_floor: tuple[bool, bool], flight: Flown, fps: float
) -> Motion:
    """A gap with its keyframes, from one that stands to one in the air or back: the trunk leans, before
    the flight each foot is where the keyframe has it, and legs bend to follow.

    In the air a foot goes with the root: what it is off its place in the keyframe becomes less, with the
    speed that it has as the heel rises. Landing is the same backwards.

    Args:
        motion: root `(T, 3)` m and rotations `(T, J, 4)` wxyz.
        off_floor: which keyframe is in the air.
        flight: of the frames between.
    """
    try:
        anatomy = find_anatomy(skeleton)
    except PoiseError:
        return motion
    ankles, hips = anatomy.of("foot"), [anatomy.of("thigh", side) for side in ("left", "right")]
    if not ankles or not all(hips) or off_floor[0] == off_floor[1]:
        return motion
    (root, rot), back = motion, off_floor[0]
    offsets = torch.tensor(np.array(skeleton.offsets), dtype=rot.dtype)
    pos = forward_kinematics(skeleton.parents, offsets, root, rot)[0]
    stands = -1 if back else 0
    left = (pos[stands, hips[0][0]] - pos[stands, hips[1][0]]) * root.new_tensor((1.0, 1.0, 0.0))
    left = left / left.norm().clamp_min(1e-9)
    facing = torch.stack((left[1], -left[0], left[2]))
    root, turned = root.clone(), rot.clone()
    root[1:-1] -= TRUNK_M * flight.lean.sin()[:, None] * facing
    lean = axis_angle_to_quat(left.expand(len(flight.lean), 3), flight.lean)
    turned[1:-1, 0] = quat_mul(lean, rot[1:-1, 0])
    pos, quat = forward_kinematics(skeleton.parents, offsets, root, turned)
    toes = {skeleton.parents[toe]: toe for _, toe in anatomy.toes}
    goals: dict[int | str, Tensor] = {}
    for joint in ankles:
        sole = pos[stands, toes[joint]] - pos[stands, joint] if joint in toes else SOLE_M * facing
        parts = [pos[:, joint], quat[:, joint], root]
        if back:
            parts = [x.flip(0) for x in parts]
        goal, turn = _leaves(*parts, sole, flight.falls[0 if back else 1], fps)
        if back:
            goal, turn = goal.flip(0), turn.flip(0)
        goals[joint] = goal
        turned[:, joint] = quat_between(quat[:, skeleton.parents[joint]], turn)
    out = match_positions(skeleton, turned, root, goals, soft=_SOFT)
    # Keyframes stay to the last digit.
    out[[0, -1]] = rot[[0, -1]]
    return root, out


def _leaves(
    ankle: Tensor, quat: Tensor, root: Tensor, sole: Tensor, fall: float, fps: float
) -> tuple[Tensor, Tensor]:
    """Where an ankle is and how it is turned, `(T, 3)` and `(T, 4)`, standing in the first frame, with
    its toes at `sole (3,)` m from it, and in the air for the last `fall` s."""
    frames = len(ankle)
    t = (torch.arange(frames, dtype=ankle.dtype) - (frames - 1)) / fps + fall
    first = max(0, min(frames - 2, int(torch.searchsorted(t, torch.tensor(0.0, dtype=t.dtype)))))
    # Heels rise by HEEL_M (1 + t / HEEL_S)^2 up to the take-off, where the legs are long.
    up = HEEL_M * (1.0 + t.clamp_max(0.0) / HEEL_S).clamp_min(0.0).square()
    zero = torch.zeros_like(up)
    raised = torch.stack((zero, zero, up), -1)
    leaves = raised.new_tensor((0.0, 0.0, 2.0 * HEEL_M / HEEL_S))
    ahead = (root[first + 1] - root[first]) * fps
    u = (t / max(fall, 1e-6)).clamp(0.0, 1.0)[:, None]
    off = hermite(
        u,
        ankle[0] + raised[first] - root[first] + ahead * t[first],
        ankle[-1] - root[-1],
        (leaves - ahead) * fall,
        torch.zeros(3, dtype=ankle.dtype),
    )
    place = torch.where((t < 0.0)[:, None], ankle[0] + raised, root + off)
    # A heel that rises turns the foot about its toes.
    flat = sole[:2] / sole[:2].norm().clamp_min(1e-9)
    axis = torch.stack((-flat[1], flat[0], 0.0 * flat[0])).expand(frames, 3)
    length = max(float(sole.norm()), HEEL_M)
    tilted = quat_mul(axis_angle_to_quat(axis, (up / length).asin()), quat[:1])
    return place, slerp(tilted, quat[-1:].expand_as(tilted), _smooth(u))


def _smooth(u: Tensor) -> Tensor:
    return (u * u * (3.0 - 2.0 * u))[:, 0]
