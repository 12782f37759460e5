"""Does a character hold itself as its reference does: upright, and on its feet, where that is.

Heights are metres above the ground, Z up. A mean distance tells neither: a character that lies at the
feet of a reference that stands is 0.4 m off.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from poise.metrics.shapes import Shapes, geom_heights

UPRIGHT_DEG = 45.0
"""Degrees from the vertical up to which a trunk is upright, in the reference."""
FALLEN_DEG = 60.0
"""Degrees beyond which a character's trunk is not, where the reference's is."""
HEAD_SHARE = 0.8
"""Of the reference's height of the head; kneeling it is at 0.7 of standing."""
FOOT_M = 0.05
"""m; a reference is on its feet where one of them is this near the ground."""
OFF_M = 0.1
"""m; a character is off its feet where all of them are higher."""
LASTING_S = 0.5
"""s; shorter spells are a stumble or a hop."""


def fallen(pos: Tensor, ref: Tensor, head: int, root: int = 0) -> Tensor:
    """Frames `(..., T)` in which the reference is upright and the character is not.

    With d the way from the root to the head and z up, the reference is upright where the angle of d and
    z is at most `UPRIGHT_DEG`. The character has fallen there if its own angle is above `FALLEN_DEG`, or
    its head lower than `HEAD_SHARE` of the reference's.

    Args:
        pos, ref: `(..., T, B, 3)` m.
    """
    lean, own = (_lean(x[..., head, :] - x[..., root, :]) for x in (ref, pos))
    low = pos[..., head, 2] < HEAD_SHARE * ref[..., head, 2]
    return (lean <= math.radians(UPRIGHT_DEG)) & ((own > math.radians(FALLEN_DEG)) | low)


def off_feet(
    pos: Tensor, quat: Tensor, ref: Tensor, ref_quat: Tensor, shapes: Shapes, feet: tuple[int, ...]
) -> Tensor:
    """Frames `(..., T)` in which the reference has a foot within `FOOT_M` of the ground, and the
    character none within `OFF_M`.

    Args:
        pos, ref: `(..., T, B, 3)` m. quat, ref_quat: `(..., T, B, 4)` wxyz.
        feet: the bodies that are feet; their shapes tell heights.
    """
    own = shapes.of_bodies(feet)
    height, stands = (geom_heights(*x, own).amin(-1) for x in ((pos, quat), (ref, ref_quat)))
    return (stands <= FOOT_M) & (height > OFF_M)


def first_lasting(bad: Tensor, fps: float) -> Tensor:
    """`(...)` long, the first frame of a spell of `bad (..., T)` that lasts `LASTING_S`, else -1."""
    frames = max(1, round(LASTING_S * fps))
    if bad.shape[-1] < frames:
        return torch.full(bad.shape[:-1], -1, dtype=torch.long, device=bad.device)
    lasting = bad.unfold(-1, frames, 1).all(-1)
    return torch.where(lasting.any(-1), lasting.long().argmax(-1), -1)


def _lean(way: Tensor) -> Tensor:
    """Angle (rad) of vectors `(..., 3)` and the vertical."""
    return torch.atan2(way[..., :2].norm(dim=-1), way[..., 2])
