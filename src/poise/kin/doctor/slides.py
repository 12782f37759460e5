"""Standing feet held in place: first the path follows them, then each leg reaches its own spot."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from poise.kin.doctor.faults import Fault
from poise.kin.doctor.support import Support, foot_slips
from poise.kin.feet.contact import Sole
from poise.kin.feet.hold import FIRM, Standing, hold
from poise.motion import Clip

#: Deviation (s) of the Gaussian over which the common slip of standing feet is averaged, and the slip
#: (m/s) that a rolling sole has anyway and that is left.
COMMON_S, ROLL_SPEED = 0.4, 0.04


def mend_path(clip: Clip, support: Support, faults: list[Fault]) -> Clip:
    """The clip with its root path freed of the slip that all standing feet have in common.

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


def mend_slides(clip: Clip, support: Support, faults: list[Fault]) -> Clip:
    """The clip with every sliding foot held in place while it stands, its leg bent to follow (`hold`).

    In a spell of `faults` the points of the sole that are in contact bear wholly.
    """
    contact, weights = support.contacts[1], {}
    for foot in dict.fromkeys(support.feet):
        mine = [k for k, joint in enumerate(support.feet) if joint == foot]
        slides = torch.zeros(clip.frames - 1, 1, dtype=torch.bool)
        for fault in faults:
            if fault.joint == clip.skeleton.names[foot]:
                slides[fault.start : fault.stop] = True
        if bool(slides.any()):
            weights[foot] = mine, (contact[:, mine] & slides).double() * FIRM

    def standing(pos: Tensor, _: Tensor) -> dict[int, Standing]:
        return {
            foot: Standing(Sole(pos[:, foot], support.soles[:, mine]), weight)
            for foot, (mine, weight) in weights.items()
        }

    root, rot = clip.tensors()
    out = hold(clip.skeleton, root, rot, clip.fps, standing, rounds=1)
    return clip.replaced(rot=out.numpy())


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
