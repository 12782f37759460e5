"""Standing feet held in place: first the path follows them, then each leg reaches its own spot."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from poise.kin.doctor.faults import Fault
from poise.kin.doctor.support import Support, foot_slips
from poise.kin.feet.contact import Sole
from poise.kin.feet.hold import FIRM, Standing, hold
from poise.kin.series import find_runs, gaussian
from poise.motion import Clip

#: Deviation (s) of the Gaussian over which the common slip of standing feet is averaged, and the slip
#: (m/s) that a rolling sole has anyway and that is left.
COMMON_S, ROLL_SPEED = 0.4, 0.04
#: What is faster (m/s) swings through, or skates, and is not held.
SWING_SPEED = 1.0
#: The path drifts only where soles lie flat for so long (s) and slip with no more than this share of
#: unsteadiness, each foot for this time (s) in all, and one foot tells this share of the other's slips.
FLAT_S, STEADY, TOLD_S, EXPLAINED = 0.15, 0.5, 0.3, 0.6


def drifts(support: Support) -> bool:
    """Whether the path itself drifts: what slips is one motion of the floor, the same for both feet.

    A foot tells where its whole sole is down for `FLAT_S` and slips steadily; one that rolls, pivots or
    trembles does not. From the slips of either foot those of the other must follow, so that at least
    `EXPLAINED` of their energy goes.
    """
    contact = support.contacts[1].numpy()
    velocity = (torch.diff(support.soles[..., :2], dim=0) * support.fps).numpy()
    told = []
    for foot in dict.fromkeys(support.feet):
        mine = np.flatnonzero(np.array(support.feet) == foot)
        slip, weight = velocity[:, mine].mean(1), np.zeros(len(velocity))
        turning = np.linalg.norm(velocity[:, mine] - slip[:, None], axis=-1).max(1)
        for first, last in find_runs(np.all(contact[:, mine], axis=-1), 0):
            run = slice(first, last + 1)
            mean = slip[run].mean(0)
            off = np.linalg.norm(slip[run] - mean, axis=-1) + turning[run]
            size = float(np.linalg.norm(mean))
            if last - first + 1 >= FLAT_S * support.fps and np.sqrt(np.mean(off**2)) <= STEADY * size:
                weight[run] = 1.0
        told.append((slip, weight))
    if len(told) != 2 or min(weight.sum() for _, weight in told) < TOLD_S * support.fps:
        return False
    for (slip, weight), (other, here) in (told, told[::-1]):
        guess, near = _mean_near(other, here, support.fps)
        both = (weight > 0) & (near > 0)
        energy = float((slip[both] ** 2).sum())
        left = float(((slip[both] - guess[both]) ** 2).sum())
        if energy < ROLL_SPEED**2 * both.sum() or left > (1 - EXPLAINED) * energy or not both.any():
            return False
    return True


def _mean_near(slip: np.ndarray, weight: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """The mean `(T, 2)` of `slip (T, 2)` by `weight (T)` around every frame, and the weight there."""
    kernel = gaussian(COMMON_S * fps)
    parts = [np.pad(x, len(kernel) // 2) for x in (weight, slip[:, 0] * weight, slip[:, 1] * weight)]
    total, *mean = (np.convolve(x, kernel, "valid") for x in parts)
    return np.stack(mean, -1) / np.maximum(total, 1e-6)[:, None], total


def mend_path(clip: Clip, support: Support, faults: list[Fault]) -> Clip:
    """The clip with its root path freed of the slip that all standing feet have in common.

    The mean slip of the planted sole points, averaged over time, is taken off the root's horizontal
    velocity wherever feet were found to slide; slower slips than `ROLL_SPEED` stay.
    """
    feet = foot_slips(support)
    # How many feet stand, and the mean of their slips (m/s).
    weight = np.sum([contact for _, _, contact in feet], axis=0).astype(float)
    slip = np.sum([slip for _, slip, _ in feet], axis=0) / np.maximum(weight, 1.0)[:, None]
    if not weight.any() or not faults:
        return clip
    mean = _mean_near(slip, weight, clip.fps)[0]
    size = np.linalg.norm(mean, axis=-1, keepdims=True)
    mean = mean * np.maximum(1.0 - ROLL_SPEED / np.maximum(size, 1e-9), 0.0)
    near = np.zeros(clip.frames - 1)
    for fault in faults:
        near[max(fault.start - 1, 0) : fault.stop + 1] = 1.0
    # The correction fades out over the averaging time beside the spells that slide.
    reach = max(1, round(COMMON_S * clip.fps))
    # Takes 0.2 s to load, which `poise info` need not wait for.
    from scipy.ndimage import maximum_filter1d

    hull = maximum_filter1d(near, 2 * reach + 1, mode="constant")
    window = gaussian(0.3 * COMMON_S * clip.fps)
    hull = np.convolve(np.pad(hull, len(window) // 2, mode="edge"), window, "valid")
    path = np.array(clip.root_pos)
    path[1:, :2] -= np.cumsum(mean * hull[:, None], axis=0) / clip.fps
    return clip.replaced(root_pos=path)


def mend_slides(clip: Clip, support: Support, faults: list[Fault]) -> Clip:
    """The clip with every sliding foot held in place while it stands, its leg bent to follow (`hold`).

    In a spell of `faults` the points of the sole that are in contact bear, see `Standing`, but where
    they swing through.
    """
    speed, contact = support.contacts
    contact, weights = contact & (speed <= SWING_SPEED), {}
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
