"""Seams between kept and generated frames: other rates, and ends that meet in place and speed."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.spatial import (
    normalize,
    quat_conj,
    quat_mul,
    quat_to_rotvec,
    rotvec_to_quat,
    slerp,
    unwrap_quats,
)


def sampled(root: Tensor, rot: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Frames at real-valued places `at (K)` of a path: positions on a cubic, rotations by arcs.

    root `(T, 3)`, rot `(T, J, 4)`. The cubic is Catmull and Rom's, which runs through every frame.
    """
    last = len(root) - 1
    low = at.floor().long().clamp(0, max(0, last - 1))
    t = (at - low).unsqueeze(-1)
    if last == 0:
        return root.expand(len(at), 3), rot.expand(len(at), *rot.shape[1:])
    p = [root[(low + k).clamp(0, last)] for k in (-1, 0, 1, 2)]
    cubic = (
        p[1]
        + 0.5 * t * (p[2] - p[0])
        + t**2 * (p[0] - 2.5 * p[1] + 2 * p[2] - 0.5 * p[3])
        + t**3 * (1.5 * (p[1] - p[2]) + 0.5 * (p[3] - p[0]))
    )
    return cubic, slerp(rot[low], rot[low + 1], t.expand(-1, rot.shape[1]))


def fade(count: int, frames: int) -> Tensor:
    """Weights `(count)` from 1 at the first frame down to 0 after `frames`, and at the last frame."""
    reach = max(1, min(frames, count - 1))
    t = (torch.arange(count, dtype=torch.float64) / reach).clamp(max=1.0)
    return 0.5 * (1 + torch.cos(torch.pi * t))


def spread(ends: tuple[Tensor, Tensor], made: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Generated frames that lead from one kept frame to another, with what they miss of either spread
    over all of them.

        y(i) += (1 - s(i)) (x(0) - (2 y(1) - y(2))) + s(i) (x(n+1) - (2 y(n) - y(n-1))),

    with s from 0 to 1 along a smooth step, and for rotations the same in turns: an end that the motion
    misses by far is not made up for in a jerk.

    Args:
        ends: root `(2, 3)` and rotations `(2, J, 4)` of the kept frames.
        made: root `(n, 3)` and rotations `(n, J, 4)` between them.
    """
    (ends_root, ends_rot), (root, rot) = ends, made
    n = len(root)
    if n < 2:
        return root.clone(), rot.clone()
    t = torch.arange(1, n + 1, dtype=root.dtype) / (n + 1)
    ease = t * t * (3 - 2 * t)
    shift, turn = torch.zeros_like(root), torch.zeros(n, rot.shape[1], 3, dtype=rot.dtype)
    for k, (a, b), weight in ((0, (1, 0), 1 - ease), (1, (n - 2, n - 1), ease)):
        place, pose = _ahead(root, rot, a, b)
        shift += weight[:, None] * (ends_root[k] - place)
        turn += weight[:, None, None] * quat_to_rotvec(quat_mul(ends_rot[k], quat_conj(pose)))
    return root + shift, normalize(quat_mul(rotvec_to_quat(turn), rot))


def meet(root: Tensor, rot: Tensor, before: int, after: int, blend: int) -> tuple[Tensor, Tensor]:
    """A path; its generated middle leaves and reaches the kept frames at their speed.

        y(1) = x(0) + (x(0) - x(-1)),   y(n) = x(n+1) - (x(n+2) - x(n+1)),

    and for rotations the same in turns. What that asks for is added to the frames between and fades
    over `blend` frames. A lone kept frame at the end has no speed of its own: what is missing from where
    the motion leads to it is made up over the last `blend` frames. A single frame between two moving
    ends takes the mean of both wishes.

    Args:
        root `(T, 3)`, rot `(T, J, 4)`: kept frames, generated frames, kept frames.
        before, after: how many frames are kept at the beginning and at the end.
    """
    root, rot = root.clone(), unwrap_quats(rot)
    n = len(root) - before - after
    if n < 1:
        return root, rot
    gap = slice(before, before + n)
    wishes = []
    if before >= 2:
        wishes.append((_ahead(root, rot, before - 2, before - 1), 0, fade(n, blend)))
    if after >= 2:
        end = before + n
        wishes.append((_ahead(root, rot, end + 1, end), n - 1, fade(n, blend).flip(0)))
    share = 1.0 if n > 1 else 1.0 / max(1, len(wishes))
    shift, turn = torch.zeros_like(root[gap]), torch.zeros(n, rot.shape[1], 3, dtype=rot.dtype)
    for (place, pose), at, weight in wishes:
        weight = weight.to(root) * share
        shift += weight[:, None] * (place - root[before + at])
        apart = quat_to_rotvec(quat_mul(pose, quat_conj(rot[before + at])))
        turn += weight[:, None, None] * apart
    if after == 1 and n > 1:
        # y(i) += s(i) (x(n+1) - (2 y(n) - y(n-1))),  s from 0 to 1 along a smooth step
        t = (torch.arange(n, dtype=root.dtype) - (n - 1 - min(blend, n - 1))).clamp_min(0)
        t = t / (min(blend, n - 1) + 1)
        ease = t * t * (3 - 2 * t)
        place, pose = _ahead(root, rot, before + n - 2, before + n - 1)
        shift += ease[:, None] * (root[before + n] - place)
        turn += ease[:, None, None] * quat_to_rotvec(quat_mul(rot[before + n], quat_conj(pose)))
    root[gap] += shift
    rot[gap] = normalize(quat_mul(rotvec_to_quat(turn), rot[gap]))
    return root, unwrap_quats(rot)


def _ahead(root: Tensor, rot: Tensor, a: int, b: int) -> tuple[Tensor, Tensor]:
    """Where the motion from frame `a` to frame `b` leads one frame later."""
    return 2 * root[b] - root[a], quat_mul(quat_mul(rot[b], quat_conj(rot[a])), rot[b])
