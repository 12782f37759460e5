"""Environments: imitation as a list of terms over many simulated worlds."""

from poise.env.env import ImitationEnv, TaskConfig
from poise.env.frame import DoneTerm, Frame, ObsTerm, RewardTerm
from poise.env.gym import GymEnv, GymVectorEnv
from poise.env.reference import Reference

__all__ = [
    "DoneTerm",
    "Frame",
    "GymEnv",
    "GymVectorEnv",
    "ImitationEnv",
    "ObsTerm",
    "Reference",
    "RewardTerm",
    "TaskConfig",
]
