"""Environments: imitation as a list of terms over many simulated worlds."""

from poise.env.env import ImitationEnv, TaskConfig
from poise.env.frame import DoneTerm, Frame, ObsTerm, RewardTerm
from poise.env.reference import Reference

__all__ = [
    "DoneTerm",
    "Frame",
    "ImitationEnv",
    "ObsTerm",
    "Reference",
    "RewardTerm",
    "TaskConfig",
]
