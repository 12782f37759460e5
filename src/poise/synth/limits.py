"""What a filled gap may do: speeds that people reach, heights over the floor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.motion import Skeleton
from poise.spatial import forward_kinematics, slerp

#: m/s, the fastest of a thousand frames of each part in CMU's motions and DeepMimic's (30 Hz, 62 clips).
FASTEST = {
    "pelvis": 4.0, "spine": 3.5, "neck": 3.6, "head": 3.6, "clavicle": 3.5, "upper_arm": 4.0,
    "forearm": 6.5, "hand": 9.0, "thigh": 4.0, "shin": 6.5, "foot": 10.0,
}  # fmt: skip
#: Shares of the network's motion that are tried, the rest being interpolated.
SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
#: m above its height on the floor from which on a body is in the air.
ALOFT_M = 0.12
#: m under the floor from which on a keyframe is no longer a foot that sank in.
UNDER_M = 0.1

#: Of the heights of the lower foot in frames that are kept, this share is where it stands.
_STANDS = 0.3

#: Root `(T, 3)` m and rotations `(T, J, 4)`.
Motion = tuple[Tensor, Tensor]
#: What is done with the feet of a gap: held where the network says that they stand, led from one place
#: where they stand to the next (`synth.footsteps`), or left alone.
Feet = Literal["held", "stepped", "free"]


def fastest(skeleton: Skeleton) -> Tensor:
    """`(J,)` m/s that each joint reaches at most; infinite where a joint is no known part of a body."""
    out = torch.full((len(skeleton),), torch.inf, dtype=torch.float64)
    try:
        parts = find_anatomy(skeleton).parts
    except PoiseError:
        return out
    for part in parts:
        out[part.joint] = FASTEST.get(part.kind, torch.inf)
    return out


def excess(skeleton: Skeleton, limits: Tensor, motion: Motion, fps: float) -> tuple[float, int]:
    """By how much the fastest joint goes beyond its limit, as a factor, and which one it is."""
    offsets = torch.tensor(np.array(skeleton.offsets), dtype=motion[0].dtype)
    pos = forward_kinematics(skeleton.parents, offsets, *motion)[0]
    over = (pos.diff(dim=0).norm(dim=-1) * fps).amax(0) / limits
    joint = int(over.argmax())
    return float(over[joint]), joint


class Calmed(NamedTuple):
    """A gap that keeps to what people reach.

    Attributes:
        motion: its frames.
        share: of the network's motion in them; the rest is interpolated.
        feet: what is done with them.
        over: by which factor the fastest joint goes beyond its limit all the same, 1 at most if not.
    """

    motion: Motion
    share: float
    feet: Feet
    over: float


def calmed(
    made: Motion,
    plain: Motion,
    finish: Callable[[Motion, Feet], Motion],
    over: Callable[[Motion], float],
    ways: Sequence[Feet] = ("held", "free"),
    most: float = 1.0,
) -> Calmed:
    """The motion with as much of the network's as keeps every joint within its limit.

    Feet are held while that is possible: where they are held in places that they cannot reach in time,
    nothing of the network's motion helps, and the next of `ways` is tried.

    Args:
        made: what the network makes of a gap. plain: the gap interpolated.
        finish: a gap's frames as they are delivered, with ends met, and with feet in one of the ways.
        over: by which factor the fastest joint of finished frames goes beyond its limit.
        most: the largest share of the network's motion.
    """
    best: Calmed | None = None
    for way in ways:
        for share in (x for x in SHARES if x <= most):
            part = torch.tensor(share, dtype=made[1].dtype).expand(made[1].shape[:2])
            mixed = torch.lerp(plain[0], made[0], share), slerp(plain[1], made[1], part)
            done = finish(mixed, way)
            tried = Calmed(done, share, way, over(done))
            if tried.over <= 1.0:
                return tried
            if best is None or tried.over < best.over:
                best = tried
    assert best is not None
    return best


def lowest(skeleton: Skeleton, motion: Motion) -> Tensor:
    """`(T,)` m, the height of the lowest joint."""
    offsets = torch.tensor(np.array(skeleton.offsets), dtype=motion[0].dtype)
    return forward_kinematics(skeleton.parents, offsets, *motion)[0][..., 2].amin(-1)


def off_floor(skeleton: Skeleton, motion: Motion) -> Tensor:
    """`(T,)` m, how much higher the lowest joint is than in the frames that stand, of all given."""
    low = lowest(skeleton, motion)
    return low - low.quantile(0.1)


def standing_heights(skeleton: Skeleton, motion: Motion) -> tuple[float, float]:
    """m, how high the ankle and the toes are of the lower foot, in most frames; 0 without feet."""
    try:
        anatomy = find_anatomy(skeleton)
    except PoiseError:
        return 0.0, 0.0
    ankles, toes = anatomy.of("foot"), [toe for _, toe in anatomy.toes]
    if not ankles or not toes:
        return 0.0, 0.0
    offsets = torch.tensor(np.array(skeleton.offsets), dtype=motion[0].dtype)
    height = forward_kinematics(skeleton.parents, offsets, *motion)[0][..., 2]
    low = (height[:, list(some)].amin(-1).quantile(_STANDS) for some in (ankles, toes))
    ankle, toe = (float(x) for x in low)
    return ankle, toe


def under_floor(skeleton: Skeleton, motion: Motion) -> Tensor:
    """`(T,)` m that the lowest joint lies under the floor at 0; 0 where it does not, or where most
    frames lie as low, since their floor then is elsewhere."""
    low = lowest(skeleton, motion)
    deep = (low < -UNDER_M) & (low < low.median() - UNDER_M)
    return torch.where(deep, -low, torch.zeros_like(low))
