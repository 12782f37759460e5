"""Environments: imitation as a list of terms over many simulated worlds."""

from poise.env.env import ImitationEnv
from poise.env.expert import Expert, ExpertConfig, Plan, make_plan
from poise.env.follower import Follower
from poise.env.frame import DoneTerm, Frame, ObsTerm, RewardTerm
from poise.env.gym import GymEnv, GymVectorEnv
from poise.env.path_config import PathConfig, Paths, PathStats
from poise.env.paths import PathSearch
from poise.env.recovery import Recovery
from poise.env.reference import Reference
from poise.env.search import Found, Search, SearchConfig
from poise.env.task import Acts, EnvStep, TaskConfig

__all__ = [
    "Acts",
    "DoneTerm",
    "EnvStep",
    "Expert",
    "ExpertConfig",
    "Follower",
    "Found",
    "Frame",
    "GymEnv",
    "GymVectorEnv",
    "ImitationEnv",
    "ObsTerm",
    "PathConfig",
    "PathSearch",
    "PathStats",
    "Paths",
    "Plan",
    "Recovery",
    "Reference",
    "RewardTerm",
    "Search",
    "SearchConfig",
    "TaskConfig",
    "make_plan",
]
