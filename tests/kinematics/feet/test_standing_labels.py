"""Feet that stand in recordings with sliding feet."""

from __future__ import annotations

import numpy as np

from poise.kinematics.feet import standing_labels
from poise.synthesis.windows import step_contacts


def walk(drift: float, floor: float, frames: int = 120) -> np.ndarray:
    """An ankle and a toe that stand for 20 frames, sliding by `drift` m/s, and swing for 10."""
    t = np.arange(frames, dtype=float)
    swing = (t % 30) >= 20
    x = np.cumsum(np.where(swing, 1.5, drift) / 30, 0)
    lift = np.where(swing, 0.15 * np.abs(np.sin(np.pi * ((t % 30) - 19.5) / 10)), 0.0)
    height = np.array([0.08, 0.02], dtype=float)
    z = floor + height + lift[:, None]
    return np.stack((np.tile(x[:, None], (1, 2)), np.zeros((frames, 2)), z), -1)


def test_sliding_feet_stand_on_whatever_floor_they_are() -> None:
    clips = [walk(0.1, 0.0), walk(0.02, 0.03), walk(0.12, -0.02, 90)]
    for clip, labels in zip(clips, standing_labels(clips, 30.0), strict=True):
        stands = (np.arange(len(clip)) % 30) < 20
        assert labels.shape == clip.shape[:2] and labels.dtype == bool
        # A frame at either end of a spell may go either way.
        assert (labels == stands[:, None]).astype(float).mean() > 0.9
    # By steps alone the sliding ones never stand.
    assert step_contacts(clips[0]).astype(float).mean() < 0.05


def test_feet_that_never_rest_have_no_floor_to_stand_on() -> None:
    (labels,) = standing_labels([walk(1.0, 0.0)], 30.0)
    assert not labels.any()
