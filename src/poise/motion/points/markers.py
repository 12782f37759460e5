"""Joint centres from surface markers: Plug-in Gait, the CMU set and OpenCap's augmented markers."""

from __future__ import annotations

import numpy as np

from poise.motion.keypoints import Keypoints


def find_markers(
    points: Keypoints, known: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Tracks of the places that surface markers tell, NaN where missing, and notes."""
    return {}, []
