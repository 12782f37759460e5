"""The policy that comes with Poise goes on learning in a task that sees what it sees."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import torch

from poise.env import TaskConfig
from poise.jobs.tracker import Tracker
from poise.learn import LATEST, AmpConfig, IterationStats, Until, WarmStart, load_policy, run
from poise.recipes.imitation import Imitation

#: rad, noise of the actions; Adam's step size.
STD, RATE = 0.08, 2e-5


def as_lesson(tracker: Tracker, task: Imitation, own: TaskConfig, worlds: int, seed: int) -> Imitation:
    """The task with settings of its own, and PPO for networks of the policy's and the critic's sizes."""
    assert tracker.value is not None
    widths = [
        tuple(len(v) for k, v in sorted(part.state().items()) if k.endswith("weight"))[:-1]
        for part in (tracker.policy, tracker.value)
    ]
    ppo = replace(
        task.config.ppo, horizon=16, minibatch=1024, policy_lr=RATE, std=STD, policy_hidden=widths[0],
        value_hidden=widths[1],
    )  # fmt: skip
    return replace(task, task=own, config=replace(task.config, num_envs=worlds, seed=seed, ppo=ppo))


def gone_on(
    tracker: Tracker, task: Imitation, folder: Path, until: Until, style: AmpConfig | None = None
) -> Tracker:
    """The policy after its training; goes on where a run of the folder stopped."""
    start = tracker.policy.copy()
    std = {k: torch.full_like(v, math.log(STD)) for k, v in start.state().items() if "log_std" in k}
    start.load_state({**start.state(), **std})
    assert tracker.value is not None
    warm = WarmStart(start, tracker.value.state())
    last = [0.0]

    def tell(stats: IterationStats) -> None:
        if time.monotonic() - last[0] > 30.0:
            last[0] = time.monotonic()
            told = f"{stats.seconds / 60:.1f} min, reward {stats.reward:.3f}"
            print(f"{folder.name}: {told}", flush=True)

    run(
        task.trainer(threads=1, warm_start=warm, style=style), until, folder, 10, tell, tensorboard=False
    )
    return replace(tracker, policy=load_policy(folder / LATEST))
