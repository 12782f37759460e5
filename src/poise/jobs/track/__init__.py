"""Tracking any motion with a trained policy: one simulated episode, nothing is trained."""

from poise.jobs.track.controllers import ResetOnFail, look_ahead
from poise.jobs.track.tracking import (
    imitation_of,
    side_by_side,
    track,
)
from poise.jobs.track_settings import TrackConfig

__all__ = [
    "ResetOnFail",
    "TrackConfig",
    "imitation_of",
    "look_ahead",
    "side_by_side",
    "track",
]
