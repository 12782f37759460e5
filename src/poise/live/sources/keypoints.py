"""A frame of keypoints on its way from a source to what fits a body to it."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np


class Frame(NamedTuple):
    """Keypoints `(K, 3)` m of a person, Z up, NaN where one is missing, and when they were and came."""

    person: str
    names: tuple[str, ...]
    points: np.ndarray
    time_s: float
    arrived_s: float


class Fits(Protocol):
    """What frames go to."""

    def offer(self, frame: Frame) -> None:
        """Takes a frame; returns at once."""
        ...
