"""A run of the perpetual recipe on two cuts of the embedded walk, with tiny networks, in seconds."""

from __future__ import annotations

from pathlib import Path

import poise
from made_once import copied
from poise.formats import read_clip
from poise.jobs.perpetual import perpetual_run
from poise.learn import PPOConfig, Until
from poise.motion import Clip, ClipLibrary, trim
from poise.recipes.perpetual_settings import Perpetual

WALK = Path(poise.__file__).parent / "data/walk.bvh"
PPO = PPOConfig(
    horizon=4, epochs=1, minibatch=64, std=0.02, policy_hidden=(16,), value_hidden=(16,), norm_warmup=2
)


def walk(start: int = 0, stop: int | None = None, name: str = "walk") -> Clip:
    """A cut of the embedded walk, 30 frames per second."""
    return trim(read_clip(WALK), start, stop).replaced(name=name)


def toy_run(folder: Path, goal: str = "rotations") -> Path:
    """A run folder with a policy that was trained for three iterations, and falls soon."""
    return copied(f"toy-run-{goal}", lambda place: _trained(place, goal), folder)


def _trained(folder: Path, goal: str) -> None:
    library = ClipLibrary.of([walk(0, 30, "first"), walk(25, 60, "second")])
    plain = {"num_envs": 8, "evaluate_every": 100, "seed": 1, "expert": False, "style": None}
    sizes = {"single_hidden": (24, 16), "ppo": PPO, "goal": goal}
    config = Perpetual(**(plain | sizes))  # type: ignore[arg-type]
    imitation = perpetual_run.begin(folder, library, config)
    perpetual_run.train(imitation, folder, Until(iterations=3), threads=1, tensorboard=False)
