"""Series of frames: runs in which something holds, and smooth means, hulls and fades."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor


def find_runs(bad: np.ndarray, gap: int) -> list[tuple[int, int]]:
    """First and last index of every run of true in `bad (T)`; runs at most `gap` apart are one."""
    at = np.flatnonzero(bad)
    if not len(at):
        return []
    return [(int(s[0]), int(s[-1])) for s in np.split(at, np.flatnonzero(np.diff(at) > gap + 1) + 1)]


def gaussian(sigma: float, reach: int | None = None) -> np.ndarray:
    """Weights of sum 1 over +-`reach` frames, by default three deviations `sigma`."""
    reach = max(1, math.ceil(3 * sigma)) if reach is None else reach
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    return kernel / kernel.sum()


def gaussian_sums(path: Tensor, sigma: float) -> tuple[Tensor, Tensor, int]:
    """Weighted sums `(T, n)` of `path (T, n)` over three deviations `sigma`, the ends held; the sum of
    the weights; and the reach in frames."""
    reach = math.ceil(3 * sigma)
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=path.dtype) / sigma) ** 2)
    padded = torch.cat((path[:1].expand(reach, -1), path, path[-1:].expand(reach, -1)))
    return (padded.unfold(0, 2 * reach + 1, 1) * kernel).sum(-1), kernel.sum(), reach


def fade_beside(frames: int, start: int, stop: int, reach: int) -> Tensor:
    """`(T)` 1 in the frames `start` to `stop`, falling to 0 over `reach` frames beside them."""
    at = torch.arange(frames, dtype=torch.float64)
    away = torch.maximum(start - at, at - stop).clamp(0, reach) / reach
    return 0.5 + 0.5 * torch.cos(math.pi * away)


def smooth_lift(depth: np.ndarray, fps: float, seconds: float, cyclic: bool = False) -> np.ndarray:
    """The smooth lift `(T,)` that covers `depth (T,)`, both in m, spread over +-`seconds`."""
    return np.maximum(smooth_hull(depth, max(1, round(seconds * fps)), cyclic), 0.0)


def smooth_hull(values: np.ndarray, reach: int, cyclic: bool) -> np.ndarray:
    """The running maximum of `values (T,)` over +-reach frames, averaged over as many."""
    if cyclic:
        # The last frame is the first one again, so it counts once.
        values = np.maximum(values[:-1], np.append(values[-1], values[1:-1]))
    mode = "wrap" if cyclic else "edge"
    # SciPy's maximum filter takes 0.2 s to load, which `poise info` need not wait for.
    hull = sliding_window_view(np.pad(values, reach, mode=mode), 2 * reach + 1).max(-1)
    window = np.hanning(2 * reach + 3)[1:-1]
    padded = np.pad(hull, reach, mode=mode)
    smooth = np.convolve(padded, window / window.sum(), "valid")
    return np.append(smooth, smooth[0]) if cyclic else smooth
