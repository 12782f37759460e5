"""Constants of the world."""

GRAVITY = 9.81
"""Standard gravity, m/s^2."""
