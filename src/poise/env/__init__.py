"""Environments: imitation as a list of terms over many simulated worlds."""

from poise.env.env import ImitationEnv, TaskConfig
from poise.env.expert import Expert, ExpertConfig, Plan, make_plan
from poise.env.frame import DoneTerm, Frame, ObsTerm, RewardTerm
from poise.env.gym import GymEnv, GymVectorEnv
from poise.env.reference import Reference

__all__ = [
    "DoneTerm",
    "Expert",
    "ExpertConfig",
    "Frame",
    "GymEnv",
    "GymVectorEnv",
    "ImitationEnv",
    "ObsTerm",
    "Plan",
    "Reference",
    "RewardTerm",
    "TaskConfig",
    "make_plan",
]
