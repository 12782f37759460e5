"""Poise gives any human motion a body: a clip in, the same motion physically simulated out."""

__version__ = "0.1.0"
