"""Standing feet held in place: first the path follows them, then each leg reaches its own spot."""

from __future__ import annotations

import math

import numpy as np
import torch

from poise.kin.doctor.faults import Fault
from poise.kin.doctor.support import Support, foot_slips
from poise.kin.limbs import limb_of, match_positions
from poise.kin.runs import find_runs
from poise.motion import Clip

#: Deviation (s) of the Gaussian over which the common slip of standing feet is averaged, and the slip
#: (m/s) that a rolling sole has anyway and that is left.
COMMON_S, ROLL_SPEED = 0.4, 0.04
#: Longest time (s) over which a foot gets from its corrected place back to its own, and the time (s) in
#: which it comes to rest and leaves again.
RETURN_S, REST_S = 0.25, 0.03


def lock_path(clip: Clip, support: Support, faults: list[Fault]) -> Clip:
    """The clip whose root path is freed of the slip that all standing feet have in common.

    The mean slip of the planted sole points, averaged over time, is taken off the root's horizontal
    velocity wherever feet were found to slide; slower slips than `ROLL_SPEED` stay.
    """
    slip, weight = _slips(clip, support)
    if not weight.any() or not faults:
        return clip
    kernel = _gaussian(COMMON_S * clip.fps)
    total = np.convolve(np.pad(weight, len(kernel) // 2), kernel, "valid")
    mean = np.stack(
        [np.convolve(np.pad(slip[:, k] * weight, len(kernel) // 2), kernel, "valid") for k in range(2)],
        -1,
    )
    mean = mean / np.maximum(total, 1e-6)[:, None]
    size = np.linalg.norm(mean, axis=-1, keepdims=True)
    mean = mean * np.maximum(1.0 - ROLL_SPEED / np.maximum(size, 1e-9), 0.0)
    near = np.zeros(clip.frames - 1)
    for fault in faults:
        near[max(fault.start - 1, 0) : fault.stop + 1] = 1.0
    # The correction fades out over the averaging time beside the spells that slide.
    reach = max(1, round(COMMON_S * clip.fps))
    hull = np.lib.stride_tricks.sliding_window_view(np.pad(near, reach), 2 * reach + 1).max(-1)
    window = _gaussian(0.3 * COMMON_S * clip.fps)
    hull = np.convolve(np.pad(hull, len(window) // 2, mode="edge"), window, "valid")
    path = np.array(clip.root_pos)
    path[1:, :2] -= np.cumsum(mean * hull[:, None], axis=0) / clip.fps
    return clip.replaced(root_pos=path)


def lock_feet(clip: Clip, support: Support, faults: list[Fault]) -> Clip:
    """The clip with every sliding foot held in place while it stands, its leg bent to follow.

    In a spell the ankle gives back what the standing part of its sole slips; it is moved least on
    average, and returns to its own path over `RETURN_S` or half of the time to the next spell.
    """
    shifts: dict[int, np.ndarray] = {}
    skeleton = clip.skeleton
    for foot, slip, contact in foot_slips(support):
        mine = [f for f in faults if f.joint == skeleton.names[foot]]
        if mine:
            shifts[foot] = _shift(slip, contact, mine, clip.fps)
    if not shifts:
        return clip
    pos = torch.tensor(clip.positions())
    targets: dict[int | str, torch.Tensor] = {}
    for foot, shift in shifts.items():
        targets[foot] = pos[:, foot] + torch.tensor(shift)
    root, rot = clip.tensors()
    reached, out = match_positions(skeleton, rot, root, targets), rot.clone()
    for foot, shift in shifts.items():
        moved = torch.tensor((shift != 0.0).any(-1))
        for j in limb_of(skeleton, foot):
            out[moved, j] = reached[moved, j]
    return clip.replaced(rot=out.numpy())


def _shift(slip: np.ndarray, contact: np.ndarray, faults: list[Fault], fps: float) -> np.ndarray:
    """`(T, 3)` m that undoes `slip (T - 1, 2)` m/s in the spells of `faults`, faded out beside them."""
    frames = len(slip) + 1
    out = np.zeros((frames, 3))
    ends = [(f.start, f.stop) for f in faults]
    for first, last in ends:
        steps = _held(contact[first:last], fps)[:, None] * slip[first:last] / fps
        path = np.concatenate((np.zeros((1, 2)), -np.cumsum(steps, axis=0)))
        out[first : last + 1, :2] = path - path.mean(0)
    most = max(1, round(RETURN_S * fps))
    held = np.zeros(frames, dtype=bool)
    for first, last in ends:
        held[first : last + 1] = True
    # Frames in which the foot stands well keep their place as long as there is room for the way back.
    for first, last in find_runs(~held, 0):
        length = last - first + 1
        fade = min(most, length)
        t = np.linspace(0.0, 1.0, fade + 2)[1:-1]
        share = (1.0 - t * t * (3.0 - 2.0 * t))[:, None]
        if first > 0:
            out[first : first + fade] += share * out[first - 1]
        if last < frames - 1:
            out[last - fade + 1 : last + 1] += share[::-1] * out[last + 1]
    return out


def _held(contact: np.ndarray, fps: float) -> np.ndarray:
    """How firmly `(T)` a foot is held: 1 while it stands, less within `REST_S` of either end."""
    out = np.zeros(len(contact))
    for first, last in find_runs(contact, 0):
        at = np.arange(last - first + 1)
        ramp = max(1.0, REST_S * fps)
        rise = np.clip((np.minimum(at, at[::-1]) + 1) / ramp, 0.0, 1.0)
        out[first : last + 1] = rise * rise * (3.0 - 2.0 * rise)
    return out


def _slips(clip: Clip, support: Support) -> tuple[np.ndarray, np.ndarray]:
    """Mean horizontal slip `(T - 1, 2)` m/s of the feet that stand, and how many stand `(T - 1)`."""
    feet = foot_slips(support)
    count = np.sum([contact for _, _, contact in feet], axis=0).astype(float)
    total = np.sum([slip for _, slip, _ in feet], axis=0)
    return total / np.maximum(count, 1.0)[:, None], count


def _gaussian(sigma: float) -> np.ndarray:
    reach = max(1, math.ceil(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    return kernel / kernel.sum()
