"""Clips made from clips: another rate, a part, a shift, backwards. None changes its argument."""

# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.clip import Clip, check_rate
from poise.spatial import slerp

#: m/s of the root above which a motion leaps.
LEAPS = 12.0


def resample(clip: Clip, fps: float, smooth: bool = False) -> Clip:
    """The clip at another frame rate: positions linear, rotations by slerp, the duration kept.

    The last sample falls on or before the clip's last frame (within a hundredth of a frame, since
    files round their frame times).

    Args:
        smooth: to a higher rate by cubic splines through all frames, accelerations without steps, for
            motion that is known to be smooth. Straight lines have a corner at each frame, which is a
            jerk many times the motion's own. Where the root leaps lines stay straight; other leaps ring.
    """
    check_rate(fps, clip.name)
    count = int(np.floor(clip.seconds * fps + 1e-2)) + 1
    if count < 2:
        raise PoiseError(
            f"the clip lasts {clip.seconds:.3f} s, less than one frame at {fps:g} fps", clip.name
        )
    at = np.minimum(np.arange(count) / fps * clip.fps, clip.frames - 1)
    low = np.minimum(np.floor(at + 1e-9).astype(int), clip.frames - 2)
    t = np.clip(at - low, 0.0, 1.0)
    out = blended(clip, low, t)
    if smooth and fps > clip.fps:
        out = _splined(clip, at, out)
    return out.replaced(fps=float(fps))


def _splined(clip: Clip, at: np.ndarray, straight: Clip) -> Clip:
    """Frames `at (N)`, which lie between those of the clip, by cubic splines: q(t) / |q(t)| for
    rotations, each frame's quaternion on the side of the one before. Where the root leaps, as where a
    character was put back, one spline ends and the next begins; `straight` is what lies between them."""
    from scipy.interpolate import CubicSpline

    rot, root_pos, turned = clip.rot.copy(), straight.root_pos.copy(), straight.rot.copy()
    flips = (rot[1:] * rot[:-1]).sum(-1) < 0
    rot[1:][np.cumsum(flips, 0) % 2 == 1] *= -1.0
    speed = np.linalg.norm(np.diff(clip.root_pos, axis=0), axis=-1) * clip.fps
    ends = [0, *(np.flatnonzero(speed > LEAPS) + 1).tolist(), clip.frames]
    for first, end in pairwise(ends):
        here = (at >= first) & (at <= end - 1)
        if end - first < 4 or not here.any():
            continue
        every = np.arange(first, end)
        root_pos[here] = CubicSpline(every, clip.root_pos[first:end])(at[here])
        smooth = CubicSpline(every, rot[first:end])(at[here])
        turned[here] = smooth / np.linalg.norm(smooth, axis=-1, keepdims=True)
    return straight.replaced(root_pos=root_pos, rot=turned)


def blended(clip: Clip, low: np.ndarray, share: np.ndarray) -> Clip:
    """Frames `(N)`, each the share `(N)` of the way from frame `low (N)` to the next one."""
    root_pos = clip.root_pos[low] * (1 - share[:, None]) + clip.root_pos[low + 1] * share[:, None]
    rot = slerp(
        torch.tensor(clip.rot[low]),
        torch.tensor(clip.rot[low + 1]),
        torch.tensor(share)[:, None].expand(-1, len(clip.skeleton)),
    )
    return clip.replaced(root_pos=root_pos, rot=rot.numpy())


def trim(clip: Clip, start: int, stop: int | None = None) -> Clip:
    """Frames `start` up to but not including `stop`."""
    contacts = tuple((j, touch[start:stop]) for j, touch in clip.contacts)
    cut = {"root_pos": clip.root_pos[start:stop], "rot": clip.rot[start:stop], "contacts": contacts}
    return clip.replaced(**cut, cyclic=False)


def shifted(clip: Clip, offset: np.ndarray | tuple[float, float, float]) -> Clip:
    """The clip moved by `offset` m, one vector `(3,)` or one per frame `(T, 3)`."""
    return clip.replaced(root_pos=clip.root_pos + np.asarray(offset, dtype=float))


def ground_shift(clip: Clip, height: float) -> Clip:
    """The clip lifted by `height` m along +Z."""
    return shifted(clip, (0.0, 0.0, height))


def backwards(clip: Clip) -> Clip:
    """The clip from its last frame to its first.

    Accelerations, and with them the forces of muscles and floor, are the same at every pose, so that a
    motion that can be done can be done backwards; only what hits the floor hard cannot.
    """
    contacts = tuple((j, touch[::-1]) for j, touch in clip.contacts)
    return clip.replaced(root_pos=clip.root_pos[::-1], rot=clip.rot[::-1], contacts=contacts)
