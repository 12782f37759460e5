"""Tracking any motion with a trained policy: one simulated episode, nothing is trained."""

from poise.jobs.track.tracking import (
    Clean,
    Keeper,
    TrackConfig,
    Tracked,
    check_fits,
    imitation_of,
    side_by_side,
    track,
)
from poise.jobs.track.written import write

__all__ = [
    "Clean",
    "Keeper",
    "TrackConfig",
    "Tracked",
    "check_fits",
    "imitation_of",
    "side_by_side",
    "track",
    "write",
]
