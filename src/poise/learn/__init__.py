"""Networks and their training: PPO on any `VecEnv`, clones, a motion prior, networks between keyframes.

It knows neither the simulator nor the character.
"""

from poise.learn.amp import Amp, AmpConfig
from poise.learn.checkpoint import LAST_GOOD, LATEST, check_fits, load_checkpoint, save_checkpoint
from poise.learn.clone import CloneConfig, CloneStats, LessonConfig, clone
from poise.learn.mining import Convergence, ConvergenceConfig, Decision, HardNegatives, MiningConfig
from poise.learn.policy import PolicyBundle, Value, WarmStart, load_policy
from poise.learn.ppo import PPO, PPOConfig, UpdateStats, gae
from poise.learn.primitives import columns_of, compose, first_column, next_column, primitive
from poise.learn.protocols import (
    DemoSampler,
    FeatureSource,
    Lessons,
    Policy,
    StepResult,
    Style,
    Teacher,
    VecEnv,
)
from poise.learn.rollout import Rollout, TrainingError
from poise.learn.run import Log, RunResult, Until, run
from poise.learn.trainer import IterationStats, Trainer

__all__ = [
    "LAST_GOOD",
    "LATEST",
    "PPO",
    "Amp",
    "AmpConfig",
    "CloneConfig",
    "CloneStats",
    "Convergence",
    "ConvergenceConfig",
    "Decision",
    "DemoSampler",
    "FeatureSource",
    "HardNegatives",
    "IterationStats",
    "LessonConfig",
    "Lessons",
    "Log",
    "MiningConfig",
    "PPOConfig",
    "Policy",
    "PolicyBundle",
    "Rollout",
    "RunResult",
    "StepResult",
    "Style",
    "Teacher",
    "Trainer",
    "TrainingError",
    "Until",
    "UpdateStats",
    "Value",
    "VecEnv",
    "WarmStart",
    "check_fits",
    "clone",
    "columns_of",
    "compose",
    "first_column",
    "gae",
    "load_checkpoint",
    "load_policy",
    "next_column",
    "primitive",
    "run",
    "save_checkpoint",
]
