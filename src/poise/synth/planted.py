"""Feet that stay planted while a body crouches for a jump, and where it lands."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.kin.limbs import match_positions
from poise.motion import Skeleton
from poise.spatial import forward_kinematics

#: s after the take-off in which feet leave their place, and before the landing in which they take it.
LEAVE_S = 0.12
#: See `limbs.soft_reach`.
_SOFT = 0.003


def planted(skeleton: Skeleton, root: Tensor, rot: Tensor, in_air: Tensor, fps: float) -> Tensor:
    """Rotations `(T, J, 4)` of a gap with its keyframes: before a flight each foot is where the first
    keyframe has it, after it where the last one has it, with legs that bend to follow.

    Args:
        root: `(T, 3)` m. rot: `(T, J, 4)` wxyz.
        in_air: `(T,)` bool; keyframes in the air are in it.
    """
    try:
        ankles = find_anatomy(skeleton).of("foot")
    except PoiseError:
        return rot
    flight = in_air.nonzero().squeeze(-1)
    if not len(flight) or not ankles:
        return rot
    offsets = torch.tensor(np.array(skeleton.offsets), dtype=rot.dtype)
    pos = forward_kinematics(skeleton.parents, offsets, root, rot)[0]
    t = torch.arange(len(root), dtype=rot.dtype)
    goals: dict[int | str, Tensor] = {}
    for joint in ankles:
        goal = pos[:, joint]
        for stands, place, since in (
            (not bool(in_air[0]), pos[0, joint], t - flight[0]),
            (not bool(in_air[-1]), pos[-1, joint], flight[-1] - t),
        ):
            if stands:
                left = (1.0 - since / (LEAVE_S * fps)).clamp(0.0, 1.0)
                share = (left * left * (3.0 - 2.0 * left)).unsqueeze(-1)
                goal = torch.lerp(goal, place.expand_as(goal), share)
        goals[joint] = goal
    out = match_positions(skeleton, rot, root, goals, soft=_SOFT)
    # Keyframes stay to the last digit.
    out[[0, -1]] = rot[[0, -1]]
    return out
