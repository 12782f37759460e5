"""A run of the recipe compliant: begun, trained, opened.

run/
    compliant.json          the settings
    checkpoint.safetensors  the training as it stands, with the policy on top
    log.csv                 the learning curve
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from poise.env.on_top import Added, OnTop
from poise.errors import PoiseError
from poise.jobs.compliant.motions import motion_of
from poise.jobs.compliant.standing import standing
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.learn import (
    LATEST,
    IterationStats,
    PolicyBundle,
    RunResult,
    Trainer,
    Until,
    VecEnv,
    load_policy,
    run,
)
from poise.learn.lock import only_writer
from poise.machine import cores
from poise.recipes import compliant as recipe
from poise.recipes.compliant import Compliant
from poise.recipes.imitation import Imitation
from poise.settings import to_data

#: What a run begins with.
RUN_FILE = "compliant.json"


@dataclass(frozen=True, eq=False)
class Learned:
    """What was learned on top of a policy.

    Attributes:
        config: its settings.
        top: the policy.
        added: what its actions are.
    """

    config: Compliant
    top: PolicyBundle
    added: Added


def begin(folder: Path, config: Compliant) -> Compliant:
    """Writes the run file, or reads that of the run that is there.

    Raises:
        PoiseError: the folder holds a run with other settings.
    """
    file = folder / RUN_FILE
    if file.exists():
        held = _read(file)
        if held != config:
            hint = "Resume it as it is or choose another folder"
            raise PoiseError("the folder holds a run with other settings", folder, hint)
        return held
    folder.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"recipe": "compliant", "config": to_data(config)}, indent=1) + "\n")
    return config


def scene_task(config: Compliant, tracker: Tracker) -> Imitation:
    """The scene as a task of the tracker's body, with all that a policy on top sees and is paid."""
    scene = config.play()
    clip = motion_of(scene, tracker, config.seconds)
    if clip is None:
        made = standing(tracker, config.seconds + 0.1)
    else:
        made = imitation_of(tracker, [place(clip, tracker)])
    stage = scene.stage(made.humanoid, made.reference)
    own = recipe.task(made.task, stage, config, made.reference.rate_hz)
    return replace(
        made, task=own, props=stage.props, links=stage.links, touches=stage.touches, floor=stage.floor
    )


def train(
    config: Compliant,
    tracker: Tracker,
    folder: Path,
    until: Until,
    on_iteration: Callable[[IterationStats], bool | None] | None = None,
    threads: int = 0,
    tensorboard: bool = True,
) -> RunResult:
    """Trains until a limit; goes on where a run of the folder stopped."""
    task = scene_task(begin(folder, config), tracker)
    env = task.env(config.num_envs, config.seed, threads=threads, help_scale=0.0, guard=False)
    added = config.added(tracker.policy.num_obs)
    with only_writer(folder):
        trainer = Trainer(
            cast(VecEnv, OnTop(env, tracker.policy, added)), config.ppo, config.seed,
            task.humanoid.identity, {"recipe": "compliant"}, update_threads=threads or cores(),
        )  # fmt: skip
        try:
            return run(trainer, until, folder, 10, on_iteration, tensorboard)
        finally:
            trainer.close()


def open_learned(folder: Path, tracker: Tracker) -> Learned:
    """What a run has learned so far.

    Raises:
        PoiseError: no run of the recipe, nothing trained yet, or a policy of another body.
    """
    file = folder / RUN_FILE
    if not file.exists():
        hint = "Give the folder of poise train compliant"
        raise PoiseError("holds no run of the recipe compliant", folder, hint)
    config = _read(file)
    added = config.added(tracker.policy.num_obs)
    if not (folder / LATEST).exists():
        raise PoiseError("nothing was trained in it yet", folder, "Train it for some minutes")
    top = load_policy(folder / LATEST)
    if top.num_actions != added.width(len(tracker.humanoid.hinges)):
        raise PoiseError("it was trained on another body", folder, "Give the policy it was trained on")
    return Learned(config, top, added)


def _read(file: Path) -> Compliant:
    try:
        data = json.loads(file.read_text("utf-8"))
        return recipe.config_of(data["config"], file)
    except (ValueError, KeyError, TypeError) as problem:
        raise PoiseError("is no run file of the recipe compliant", file) from problem
