"""Feet that stay where they stand in a transition, where the network says that they stand."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from poise.kin.lead import Sole, lead, led
from poise.motion import Skeleton
from poise.spatial import forward_kinematics

#: How much a foot bears that the network says stands; how a foot is led is made for weights up to 1, at
#: which it may drift by millimetres per second.
_FIRM = 100.0
#: How often it is done: tilts are small, but not infinitely.
_ROUNDS = 2


def lock_feet(
    skeleton: Skeleton, feet: Sequence[int], root: Tensor, rot: Tensor, contact: Tensor, free: Tensor,
    fps: float,
) -> Tensor:  # fmt: skip
    """Rotations `(T, J, 4)` with the feet held still while they stand; the root's path stays.

    Args:
        feet: joints; ankles whose toes are among them are held, others left alone.
        root: `(T, 3)` m. rot: `(T, J, 4)` wxyz, local.
        contact: `(T, F)` bool per foot joint. free: `(T)` bool, frames that may change; the others
            (keyframes) say where a foot that stands must be.
    """
    bears = (contact[1:] & contact[:-1]).to(rot.dtype) * _FIRM
    for _ in range(_ROUNDS):
        rot = _lock_once(skeleton, list(feet), root, rot, bears, free, fps)
    return rot


def _lock_once(
    skeleton: Skeleton, feet: list[int], root: Tensor, rot: Tensor, bears: Tensor, free: Tensor,
    fps: float,
) -> Tensor:  # fmt: skip
    offsets = torch.tensor(skeleton.offsets, dtype=rot.dtype)
    pos, _ = forward_kinematics(skeleton.parents, offsets, root, rot)
    leads = {}
    for k, toe in enumerate(feet):
        ankle = skeleton.parents[toe]
        # A leg has a knee and a hip above its ankle.
        if ankle in feet and len(skeleton.ancestors(ankle)) > 2:
            sole = Sole(pos[:, ankle], pos[:, [ankle, toe]])
            weight = bears[:, [feet.index(ankle), k]]
            if bool(weight.any()):
                leads[ankle] = lead(sole, weight.numpy(), fps, (~free).numpy(), vertical=True)
    return led(skeleton, rot, root, leads) if leads else rot.clone()
