"""Terms: pure functions of a `Frame`."""

from poise.env.terms import done, obs, reward

__all__ = ["done", "obs", "reward"]
