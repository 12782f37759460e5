"""Flights of filled gaps: a root that rises and falls by gravity, and goes ahead evenly in the air."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from poise.spatial import GRAVITY

#: Depth of the crouch before and after a jump, as a share of its height, and between which it lies, m; s
#: that it takes to go down.
CROUCH, CROUCHES_M, CROUCH_S = 0.7, (0.08, 0.3), 0.35
#: s in which a body gets from rest to the level speed of its flight, besides those of pushing off; and
#: how many times as long that is as its way at this speed would take.
LEAN_S, RUN_UP = 0.18, 2.5
#: rad that the trunk leans ahead in the deepest crouch before a jump, and after it.
LEANS = (0.45, 0.15)


class Flown(NamedTuple):
    """A gap with an end in the air.

    Attributes:
        height: `(n,)` m, of the root.
        in_air: `(n,)` bool.
        level: `(n, 2)` m, of the root.
        falls: s that it is in the air after the first and before the last keyframe.
        lean: `(n,)` rad that the trunk leans ahead.
    """

    height: Tensor
    in_air: Tensor
    level: Tensor
    falls: tuple[float, float]
    lean: Tensor


def fall_s(height: float) -> float:
    """t = sqrt(2 h / g)."""
    return (2.0 * max(height, 0.0) / GRAVITY) ** 0.5


def crouch_of(height: float) -> tuple[float, float]:
    """How deep (m) a body crouches for a jump, and the s in which it pushes off from there: evenly
    accelerated to v = g t over the depth d, 2 d / v."""
    depth = min(max(CROUCH * height, CROUCHES_M[0]), CROUCHES_M[1])
    return depth, 2.0 * depth / (GRAVITY * max(fall_s(height), 1e-6))


def start_s(height: float) -> float:
    """s on the floor beside a flight in which a body goes ahead, half as fast as in the air."""
    return crouch_of(height)[1] + LEAN_S


def flight_speeds(
    places: Tensor, keys: Sequence[int], aloft: Mapping[int, float], fps: float
) -> dict[int, Tensor]:
    """The level velocity `(2,)` m/s at each keyframe in the air, the same before it and after it.

    With the ways D to the keyframes on either side, f s of each in the air and p s on the floor beside
    it, which cover half of what flight does in the time, it is the least squares solution of
    v (f + p / 2) = D. Where frames after the last keyframe or before the first are kept, they say it.

    Args:
        places: `(T, 2)` m, the root in all frames.
        keys: all keyframes. aloft: m that each is in the air.
    """
    out: dict[int, Tensor] = {}
    for k in (k for k in keys if aloft.get(k, 0.0) > 0.0):
        if k == keys[-1] and k + 1 < len(places):
            out[k] = (places[k + 1] - places[k]) * fps
        elif k == keys[0] and k > 0:
            out[k] = (places[k] - places[k - 1]) * fps
        else:
            out[k] = _speed(places, keys, aloft, k, fps)
    return out


def _speed(
    places: Tensor, keys: Sequence[int], aloft: Mapping[int, float], k: int, fps: float
) -> Tensor:
    number = list(keys).index(k)
    above, below = torch.zeros(2, dtype=places.dtype), 0.0
    fall, push = fall_s(aloft[k]), start_s(aloft[k])
    for other in (number - 1, number + 1):
        if not 0 <= other < len(keys):
            continue
        n = keys[other]
        whole, way = abs(n - k) / fps, (places[n] - places[k]) * (1 if n > k else -1)
        here = min(fall + 0.5 * push, whole)
        if aloft.get(n, 0.0) > 0.0:
            between = whole >= fall + fall_s(aloft[n])
            # With a landing between, each flight has its share of the way.
            way, here = (0.5 * way, min(fall, 0.5 * whole)) if between else (way, whole)
        above = above + here * way
        below += here * here
    return above / max(below, 1e-9)


def flown(
    height: Tensor,
    ends: Tensor,
    before: float,
    after: float,
    fps: float,
    speeds: tuple[Tensor | None, Tensor | None] = (None, None),
) -> Flown:
    """A root in a gap of n frames with an end in the air: there it rises or falls by gravity.

    A keyframe in the air is taken as the top of its flight, so that the root leaves the floor
    t = sqrt(2 h / g) before it and comes back as long after it: z(t) = z_key - g t^2 / 2. It takes off
    with v = g t from a crouch of depth d, evenly accelerated over 2 d / v, and lands in one alike. In
    the air it goes ahead evenly, and gets to that speed from rest, or from it to rest, on the floor.
    Two keyframes too near to one another for that are of one flight, a parabola through both.

    Args:
        height: `(n,)` m, the root on the straight line between the keyframes, without these.
        ends: `(2, 2)` m, where the keyframes have the root.
        before, after: how high (m) the keyframes are off the floor, 0 where they stand on it.
        speeds: `(2,)` m/s in the air beside each; from its way alone by default.
    """
    n = len(height)
    t = torch.arange(1, n + 1, dtype=height.dtype) / fps
    whole = (n + 1) / fps
    falls = fall_s(before), fall_s(after)
    if whole < sum(falls) and before > 0.0 and after > 0.0:
        rise = 0.5 * GRAVITY * t * (whole - t)
        level = torch.lerp(ends[0], ends[1], (t / whole)[:, None])
        all_ = torch.ones(n, dtype=torch.bool)
        return Flown(height + rise, all_, level, (whole, whole), torch.zeros_like(height))
    out, in_air, lean = height.clone(), torch.zeros(n, dtype=torch.bool), torch.zeros_like(height)
    sides = (before, falls[0], t, LEANS[1]), (after, falls[1], whole - t, LEANS[0])
    for off, fall, since, most in sides:
        if off <= 0.0:
            continue
        # The line's own rise goes, and what is left where the gap ends before the flight does.
        flight = (off - 0.5 * GRAVITY * since**2).clamp_min(0.0)
        rest = max(0.0, off - 0.5 * GRAVITY * whole**2)
        out = out + flight - (rest * since + off * (whole - since)) / whole
        depth, push = crouch_of(off)
        down = _crouch(since - fall, depth, push, whole - fall)
        out, lean = out - down, lean + most / depth * down
        in_air |= since < fall
    falls = (min(falls[0], whole), min(falls[1], whole))
    level = _ahead(t, whole, ends, (before, after), falls, speeds)
    return Flown(out, in_air, level, falls, lean)


def _ahead(
    t: Tensor,
    whole: float,
    ends: Tensor,
    off: tuple[float, float],
    falls: tuple[float, float],
    speeds: tuple[Tensor | None, Tensor | None],
) -> Tensor:
    """`(n, 2)` m, the level way of a root at times `t` of a gap of `whole` s."""
    flies = off[0] > 0.0, off[1] > 0.0
    if not any(flies):
        return torch.lerp(ends[0], ends[1], (t / whole)[:, None])
    way, push = ends[1] - ends[0], [start_s(h) for h in off]
    alone = way / max(sum(f + 0.5 * p for f, p, up in zip(falls, push, flies, strict=True) if up), 1e-6)
    v = [alone if one is None else one for one in speeds]
    v = [x if up else torch.zeros_like(way) for x, up in zip(v, flies, strict=True)]
    # On the floor: from where the first flight lands to where the second begins.
    start, stop = ends[0] + falls[0] * v[0], ends[1] - falls[1] * v[1]
    ground = max(whole - sum(falls), 0.0)
    longest = ground
    if not all(flies):
        k = 0 if flies[0] else 1
        longest = RUN_UP * float((stop - start).norm()) / max(float(v[k].norm()), 1e-6)
        longest = min(max(longest, crouch_of(off[k])[1]), ground)
    begins = falls[0] if flies[0] else whole - falls[1] - longest
    u = ((t - begins) / max(longest, 1e-6)).clamp(0.0, 1.0)[:, None]
    out = hermite(u, start, stop, v[0] * longest, v[1] * longest)
    out = torch.where((t < falls[0])[:, None], ends[0] + t[:, None] * v[0], out)
    return torch.where((whole - t < falls[1])[:, None], ends[1] - (whole - t)[:, None] * v[1], out)


def hermite(u: Tensor, start: Tensor, stop: Tensor, leave: Tensor, reach: Tensor) -> Tensor:
    """The cubic from `start` to `stop` at `u` from 0 to 1, with its derivatives at both ends."""
    rise = u * u * (3.0 - 2.0 * u)
    return start + rise * (stop - start) + u * (1.0 - u) ** 2 * leave - u * u * (1.0 - u) * reach


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
