"""Worlds that a policy acts in: goals, observations, rewards, ends, events, recovery."""

from poise.env.env import ImitationEnv
from poise.env.faces import GymEnv, GymVectorEnv
from poise.env.frame import DoneTerm, Frame, ObsTerm, RewardTerm
from poise.env.recovery.clock import Recovery
from poise.env.reference import Reference
from poise.env.task import Acts, EnvStep, TaskConfig

__all__ = [
    "Acts",
    "DoneTerm",
    "EnvStep",
    "Frame",
    "GymEnv",
    "GymVectorEnv",
    "ImitationEnv",
    "ObsTerm",
    "Recovery",
    "Reference",
    "RewardTerm",
    "TaskConfig",
]
