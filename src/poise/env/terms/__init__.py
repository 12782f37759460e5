"""Terms: pure functions of a `Frame`."""

from poise.env.terms import done, obs, phc_obs, phc_reward, reward

__all__ = ["done", "obs", "phc_obs", "phc_reward", "reward"]
