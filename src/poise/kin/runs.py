"""Runs of frames in which something holds."""

from __future__ import annotations

import numpy as np


def find_runs(bad: np.ndarray, gap: int) -> list[tuple[int, int]]:
    """First and last index of every run of true in `bad (T)`; runs at most `gap` apart are one."""
    at = np.flatnonzero(bad)
    if not len(at):
        return []
    return [(int(s[0]), int(s[-1])) for s in np.split(at, np.flatnonzero(np.diff(at) > gap + 1) + 1)]
