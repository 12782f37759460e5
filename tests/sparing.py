"""A single motion is learned and looked for with little: tests ask what comes of it, not how well."""

from __future__ import annotations

import pytest

from poise.jobs import practice
from poise.jobs.track import TrackConfig, learning
from poise.plan import LookaheadConfig, SamplingConfig


def spare(patch: pytest.MonkeyPatch) -> None:
    """Few worlds learn, and few characters look ahead and search."""
    few = {"lookahead": LookaheadConfig(10, 4), "search": SamplingConfig(8, retries=0)}
    patch.setattr(learning, "WORLDS", 32)
    patch.setattr(practice, "TrackConfig", lambda **how: TrackConfig(**how, **few))
