"""A written motion of which a part was simulated anew: all else stays as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from poise.errors import PoiseError
from poise.jobs.track.retaking import eased
from poise.jobs.track.simulation import Simulation
from poise.motion import Clip, read_clip
from poise.spatial import slerp

#: s over which the part takes over and gives back, within it.
TAKES_S = 0.2


def changed_s(before: Simulation, now: Simulation) -> tuple[float, float]:
    """The last moment before two simulations of a motion differ, and the first after it, s."""
    other = (before.qpos != now.qpos).any(1).nonzero()[:, 0]
    if not len(other):
        return 0.0, 0.0
    return (float(other[0]) - 1.0) / now.rate_hz, (float(other[-1]) + 1.0) / now.rate_hz


def spliced(before: Clip, now: Clip, span: tuple[float, float]) -> Clip:
    """The frames of `before`, and of `now` within a span, s, into which and out of which they pass."""
    if before.frames != now.frames:
        return now
    first, last = span
    t = torch.arange(now.frames, dtype=torch.float64) / now.fps
    takes = max(min(TAKES_S, (last - first) / 3), 1e-9)
    # What is simulated to its end has nothing to give back to.
    ends = torch.full_like(t, torch.inf) if last >= float(t[-1]) else last - t
    share = eased(torch.minimum(t - first, ends) / takes)
    old, new = before.tensors(), now.tensors()
    root = torch.lerp(old[0], new[0], share[:, None])
    rot = slerp(old[1], new[1], share[:, None].expand(-1, len(now.skeleton)))
    kept = share == 0.0
    root[kept], rot[kept] = old[0][kept], old[1][kept]
    return now.replaced(root_pos=root.numpy(), rot=rot.numpy())


def written_as(folder: Path, like: Clip) -> Clip | None:
    """The motion in a result's folder, as it was written; None where there is none with the skeleton
    and the frames of `like`."""
    files = sorted(folder.glob("simulated.*")) if folder.is_dir() else []
    if len(files) != 1:
        return None
    try:
        clip = read_clip(files[0])
    except PoiseError:
        return None
    same = clip.skeleton.same_bones(like.skeleton) and clip.frames == like.frames
    return like.replaced(root_pos=np.array(clip.root_pos), rot=np.array(clip.rot)) if same else None
