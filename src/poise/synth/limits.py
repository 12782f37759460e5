"""What a filled gap may do: speeds that people reach, and flights by gravity."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.motion import Skeleton
from poise.spatial import GRAVITY, forward_kinematics, slerp

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

#: Depth of the crouch before and after a jump, as a share of its height, and between which it lies, m; s
#: that it takes to go down.
CROUCH, CROUCHES_M, CROUCH_S = 0.7, (0.08, 0.3), 0.35

#: Root `(T, 3)` m and rotations `(T, J, 4)`.
Motion = tuple[Tensor, Tensor]


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
        held: whether feet are held.
        over: by which factor the fastest joint goes beyond its limit all the same, 1 at most if not.
    """

    motion: Motion
    share: float
    held: bool
    over: float


def calmed(
    made: Motion,
    plain: Motion,
    finish: Callable[[Motion, bool], Motion],
    over: Callable[[Motion], float],
    hold: bool = True,
    most: float = 1.0,
) -> Calmed:
    """The motion with as much of the network's as keeps every joint within its limit.

    Feet are held while that is possible: where they are held in places that they cannot reach in time,
    nothing of the network's motion helps, and they are let go.

    Args:
        made: what the network makes of a gap. plain: the gap interpolated.
        finish: a gap's frames as they are delivered, with ends met, and feet held or not.
        over: by which factor the fastest joint of finished frames goes beyond its limit.
        hold: whether feet are to be held. most: the largest share of the network's motion.
    """
    best: Calmed | None = None
    for held in (True, False) if hold else (False,):
        for share in (x for x in SHARES if x <= most):
            part = torch.tensor(share, dtype=made[1].dtype).expand(made[1].shape[:2])
            mixed = torch.lerp(plain[0], made[0], share), slerp(plain[1], made[1], part)
            done = finish(mixed, held)
            tried = Calmed(done, share, held, over(done))
            if tried.over <= 1.0:
                return tried
            if best is None or tried.over < best.over:
                best = tried
    assert best is not None
    return best


class Flown(NamedTuple):
    """A gap with an end in the air.

    Attributes:
        height: `(n,)` m, of the root.
        in_air: `(n,)` bool.
        along: `(n,)`, the share of the level way between the keyframes that is done.
    """

    height: Tensor
    in_air: Tensor
    along: Tensor


def flown(height: Tensor, before: float, after: float, fps: float) -> Flown:
    """Heights `(n)` m of a root in a gap with an end in the air: there it rises or falls by gravity.

    A keyframe in the air is taken as the top of its flight, so that the root leaves the floor
    t = sqrt(2 h / g) before it and comes back as long after it: z(t) = z_key - g t^2 / 2. It takes off
    with v = g t from a crouch of depth d, evenly accelerated over 2 d / v, and lands in one alike; it
    goes ahead over its feet in that time alone, and evenly in the air. Two keyframes too near to one
    another for that are of one flight, a parabola through both.

    Args:
        height: the root on the straight line between the keyframes, without these.
        before, after: how high (m) the keyframes are off the floor, 0 where they stand on it.
    """
    n = len(height)
    t = torch.arange(1, n + 1, dtype=height.dtype) / fps
    whole = (n + 1) / fps
    falls = (2.0 * before / GRAVITY) ** 0.5, (2.0 * after / GRAVITY) ** 0.5
    if whole < sum(falls) and before > 0.0 and after > 0.0:
        rise = 0.5 * GRAVITY * t * (whole - t)
        return Flown(height + rise, torch.ones(n, dtype=torch.bool), t / whole)
    out, in_air = height.clone(), torch.zeros(n, dtype=torch.bool)
    ways: list[Tensor] = []
    for off, fall, since, away in ((before, falls[0], t, True), (after, falls[1], whole - t, False)):
        if off <= 0.0:
            continue
        # The line's own rise goes, and what is left where the gap ends before the flight does.
        flight = (off - 0.5 * GRAVITY * since**2).clamp_min(0.0)
        rest = max(0.0, off - 0.5 * GRAVITY * whole**2)
        out = out + flight - (rest * since + off * (whole - since)) / whole
        depth = min(max(CROUCH * off, CROUCHES_M[0]), CROUCHES_M[1])
        push = 2.0 * depth / (GRAVITY * fall)
        out = out - _crouch(since - fall, depth, push, whole - fall)
        in_air |= since < fall
        left = _left(since, fall, min(push, max(whole - fall, 1e-6)))
        ways.append(left if away else 1.0 - left)
    return Flown(out, in_air, torch.stack(ways).mean(0) if ways else t / whole)


def _left(since: Tensor, fall: float, push: float) -> Tensor:
    """The share of the way to a keyframe in the air that is left `since` seconds before it."""
    whole = fall + 0.5 * push
    pushing = 1.0 - (fall + push - since).clamp_min(0.0) ** 2 / (2.0 * push * whole)
    return torch.where(since <= fall, since / whole, pushing).clamp(0.0, 1.0)


def _crouch(since: Tensor, depth: float, push: float, room_s: float) -> Tensor:
    """How deep (m) a body crouches, `since` seconds before it takes off or after it landed.

    depth: at most, m. push: s from there to the take-off. room_s: what there is of the gap.
    """
    speed = 2.0 * depth / push
    if room_s < push + CROUCH_S:
        return torch.zeros_like(since)
    pushing = depth - 0.5 * speed / push * (push - since) ** 2
    sinking = 0.5 * depth * (1.0 + torch.cos(torch.pi * (since - push) / CROUCH_S))
    down = torch.where(since <= push, pushing, sinking)
    return torch.where((since > 0.0) & (since < push + CROUCH_S), down, 0.0)


def lowest(skeleton: Skeleton, motion: Motion) -> Tensor:
    """`(T,)` m, the height of the lowest joint."""
    offsets = torch.tensor(np.array(skeleton.offsets), dtype=motion[0].dtype)
    return forward_kinematics(skeleton.parents, offsets, *motion)[0][..., 2].amin(-1)


def off_floor(skeleton: Skeleton, motion: Motion) -> Tensor:
    """`(T,)` m, how much higher the lowest joint is than in the frames that stand, of all given."""
    low = lowest(skeleton, motion)
    return low - low.quantile(0.1)


def under_floor(skeleton: Skeleton, motion: Motion) -> Tensor:
    """`(T,)` m that the lowest joint lies under the floor at 0; 0 where it does not, or where most
    frames lie as low, since their floor then is elsewhere."""
    low = lowest(skeleton, motion)
    deep = (low < -UNDER_M) & (low < low.median() - UNDER_M)
    return torch.where(deep, -low, torch.zeros_like(low))
