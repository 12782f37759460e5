"""Reinforcement learning on any `VecEnv`; it knows neither the simulator nor the character."""

from poise.learn.checkpoint import BEST, LAST_GOOD, LATEST, check_fits, load_checkpoint, save_checkpoint
from poise.learn.clone import CloneConfig, CloneStats, clone
from poise.learn.config import PPOConfig
from poise.learn.gae import gae
from poise.learn.guard import TrainingError
from poise.learn.log import Log
from poise.learn.policy import PolicyBundle, WarmStart, load_policy
from poise.learn.ppo import PPO, UpdateStats
from poise.learn.protocols import Policy, Step, Teacher, VecEnv
from poise.learn.rollout import Rollout
from poise.learn.run import RunResult, Until, run
from poise.learn.train import IterationStats, Trainer

__all__ = [
    "BEST",
    "LAST_GOOD",
    "LATEST",
    "PPO",
    "CloneConfig",
    "CloneStats",
    "IterationStats",
    "Log",
    "PPOConfig",
    "Policy",
    "PolicyBundle",
    "Rollout",
    "RunResult",
    "Step",
    "Teacher",
    "Trainer",
    "TrainingError",
    "Until",
    "UpdateStats",
    "VecEnv",
    "WarmStart",
    "check_fits",
    "clone",
    "gae",
    "load_checkpoint",
    "load_policy",
    "run",
    "save_checkpoint",
]
