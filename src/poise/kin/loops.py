"""Loops: clips that end as they begin, repeated, and one period taken out of many that closes."""

from __future__ import annotations

import numpy as np
import torch

from poise.kin.travel import moved_by
from poise.motion import Clip
from poise.spatial import heading_quat, quat_conj, quat_mul, slerp

#: The last pose is the first again, or the one before it, within this share of a frame's step and this
#: (m and rad) beside it.
SAME_SHARE, SAME = 0.35, 0.002


def overlap_of(clip: Clip) -> int | None:
    """How many frames of a loop's next period its last one repeats: 1 where it is the first again, 0
    where the first would follow; None of a clip that is no loop.

    Judged by the places of all joints: those of the next frame are those of this one and its step.
    """
    if clip.frames < 4:
        return None
    pos = clip.positions()
    reach = float(np.linalg.norm(np.ptp(pos, axis=0), axis=-1).max())
    step = np.linalg.norm(np.diff(pos[[0, 1, -2, -1]], axis=0), axis=-1)[[0, 2]].max()
    limit = SAME_SHARE * float(step) + SAME
    # What hardly moves closes anyhow.
    if reach < 10 * SAME:
        return None
    if float(np.linalg.norm(pos[-1] - pos[0], axis=-1).max()) <= limit:
        return 1
    ahead = 0.5 * (pos[1] - pos[0] + pos[-1] - pos[-2])
    return 0 if float(np.linalg.norm(pos[-1] + ahead - pos[0], axis=-1).max()) <= limit else None


def repeated(clip: Clip, overlap: int, periods: int) -> Clip:
    """So many periods of a loop, one after another, and the first frame again."""
    at = np.append(np.tile(np.arange(clip.frames - overlap), periods), 0)
    return clip.replaced(root_pos=clip.root_pos[at], rot=clip.rot[at], cyclic=False)


def best_period(clip: Clip, period: int, overlap: int, first: int = 2, stop: int | None = None) -> Clip:
    """The period that closes best of a motion of several, its ends made to meet.

    Frame i of period k is x_k(i). What is given is (1 - s) x_k(i) + s x_{k-1}(i), with s from 0 to 1 as
    smooth as s'' = 0 at its ends: it begins with x_k(0) and ends with x_{k-1}(P) = x_k(0), there with
    the motion's own speed and acceleration. By how much two periods are apart on the ground is taken
    off evenly before, as another speed.

    Args:
        period: frames P. overlap: see `overlap_of`. first: periods before it are not asked, if there
            are others, since the motion begins there. stop: frame from which the motion is lost.
    """
    count = (clip.frames - 1) // period
    end = period + overlap
    if count < 2:
        return clip.replaced(root_pos=clip.root_pos[:end], rot=clip.rot[:end])
    pos = clip.positions()
    pos = pos - pos[:, :1] * np.array([1.0, 1.0, 0.0])
    whole = count if stop is None else min(count, max(2, stop // period))
    asked = range(min(first, whole - 1), whole)

    def apart(k: int) -> float:
        here, before = (pos[j * period : (j + 1) * period + 1] for j in (k, k - 1))
        return float(np.square(here - before).mean())

    k = min(asked, key=apart)
    even = _even(clip, k, period)
    here, before = (np.arange(j * period, (j + 1) * period + 1) for j in (k, k - 1))
    s = np.linspace(0.0, 1.0, period + 1)
    share = s**3 * (10 - 15 * s + 6 * s * s)
    root = even.root_pos[here] * (1 - share[:, None]) + even.root_pos[before] * share[:, None]
    rot = slerp(
        torch.tensor(even.rot[here]),
        torch.tensor(even.rot[before]),
        torch.tensor(share)[:, None].expand(-1, even.rot.shape[1]),
    )
    return clip.replaced(root_pos=root[:end], rot=rot.numpy()[:end])


def _even(clip: Clip, k: int, period: int) -> Clip:
    """The clip with the drift from period k - 1 to k, a turn and a way on the ground, taken off evenly
    over time, so that the two lie on each other; frame k P stays where it is."""
    here, before = (slice(j * period, (j + 1) * period + 1) for j in (k, k - 1))
    share = (np.arange(clip.frames) - k * period) / period
    quat = torch.tensor(clip.rot[:, 0])
    turned = heading_quat(quat_mul(quat[here], quat_conj(quat[before])))
    angle = -float(2 * torch.atan2(turned[:, 3].sum(), turned[:, 0].sum())) * share
    x, y = clip.root_pos[k * period, :2]
    c, s = np.cos(angle), np.sin(angle)
    stays = np.stack((x - c * x + s * y, y - s * x - c * y, np.zeros(len(angle))), -1)
    clip = moved_by(clip, stays, angle)
    drift = (clip.root_pos[here] - clip.root_pos[before]).mean(0) * np.array([1.0, 1.0, 0.0])
    return clip.replaced(root_pos=clip.root_pos - share[:, None] * drift)
