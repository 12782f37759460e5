"""Errors of pose estimators, made on purpose: kinds, their composition, ladders of strength."""

from poise.motion.noise.apply import (
    TRIANGULATED,
    VIDEO,
    Level,
    hold_missing,
    perturb_clip,
    perturb_points,
    perturb_positions,
    robustness_levels,
    scaled,
)
from poise.motion.noise.base import Noise, Seen, side_pairs
from poise.motion.noise.kinds import (
    Drift,
    Dropouts,
    FrameLoss,
    Jitter,
    Latency,
    Outliers,
    SwapSides,
    WrongDepth,
)

__all__ = [
    "TRIANGULATED",
    "VIDEO",
    "Drift",
    "Dropouts",
    "FrameLoss",
    "Jitter",
    "Latency",
    "Level",
    "Noise",
    "Outliers",
    "Seen",
    "SwapSides",
    "WrongDepth",
    "hold_missing",
    "perturb_clip",
    "perturb_points",
    "perturb_positions",
    "robustness_levels",
    "scaled",
    "side_pairs",
]
