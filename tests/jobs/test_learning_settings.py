"""With which settings a policy goes on to learn one motion."""

from __future__ import annotations

from poise.jobs.open import open_run
from poise.jobs.track.learning import settings


def test_one_motion_is_learned_without_prices_on_rough_motion() -> None:
    own = open_run().tracker.config
    assert own.acceleration > 0 and own.ppo.smooth_weight > 0
    config = settings(own, seed=3, starts=4)
    assert config.acceleration == 0.0 and config.ppo.smooth_weight == 0.0
    # What it observes and does, and the other prices, are as it knows them.
    for name in ("window", "heading", "root", "action", "action_rate", "foot_slide"):
        assert getattr(config, name) == getattr(own, name)
    assert (config.seed, config.starts, config.ppo.std) == (3, 4, own.ppo.std)
