"""Acclaim (CMU): AMC motion with the ASF skeleton that it needs."""

from poise.motion.io.acclaim.amc import read_amc

__all__ = ["read_amc"]
