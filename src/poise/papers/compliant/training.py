"""A run of the recipe compliant: begun, trained, opened.

run/
    compliant.json          the settings
    checkpoint.safetensors  the training as it stands, with the policy on top
    log.csv                 the learning curve

What is on top of a policy is one file, too, `save_learned`: such a file comes along for the ball.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from poise.errors import PoiseError
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker, halved
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
from poise.learn.checkpoint import PolicyMeta, load_checkpoint, save_checkpoint
from poise.learn.lock import only_writer
from poise.learn.policy import policy_in
from poise.machine import cores
from poise.papers.compliant import recipe as recipe
from poise.papers.compliant.motions import motion_of
from poise.papers.compliant.on_top import Added, OnTop
from poise.papers.compliant.recipe import Compliant
from poise.papers.compliant.standing import standing
from poise.recipes.imitation import Imitation
from poise.settings import to_data

#: What a run begins with.
RUN_FILE = "compliant.json"
#: What comes along on top of the policy that comes along, by scene.
SHIPPED = {"ball": Path(__file__).parents[2] / "data" / "ball.safetensors"}


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
            return run(trainer, until, folder, 10, on_iteration, tensorboard, config.cooling)
        finally:
            trainer.close()


def save_learned(learned: Learned, tracker: Tracker, path: Path) -> None:
    """Writes what was learned on top of a policy as one file, its matrices in half precision."""
    meta = {
        "kind": "policy", **learned.top.identity(tracker.humanoid.identity),
        "metadata": {
            "recipe": "compliant", "config": to_data(learned.config), "below": digest_of(tracker.policy)
        },
    }  # fmt: skip
    save_checkpoint(path, {k: halved(k, v) for k, v in learned.top.state().items()}, meta)


def digest_of(policy: PolicyBundle) -> str:
    """16 hexadecimal digits that tell one policy's weights from another's."""
    told = hashlib.sha256()
    for name, value in sorted(policy.state().items()):
        told.update(name.encode() + value.contiguous().numpy().tobytes())
    return told.hexdigest()[:16]


def shipped(scene: str, tracker: Tracker) -> Learned | None:
    """What comes along for a scene; None where there is nothing, or it belongs to another policy."""
    path = SHIPPED.get(scene)
    if path is None or load_checkpoint(path)[1]["metadata"]["below"] != digest_of(tracker.policy):
        return None
    return open_learned(path, tracker)


def open_learned(folder: Path, tracker: Tracker) -> Learned:
    """What a run has learned so far, or the file that `save_learned` wrote.

    Raises:
        PoiseError: no run of the recipe, nothing trained yet, or a policy of another body.
    """
    if folder.is_file():
        tensors, meta = load_checkpoint(folder, PolicyMeta)
        told = meta.get("metadata", {})
        if told.get("recipe") != "compliant" or not isinstance(told.get("config"), dict):
            hint = "Give the folder of poise train compliant, or a file that was saved from it"
            raise PoiseError("holds nothing of the recipe compliant", folder, hint)
        config = recipe.config_of(told["config"], folder)
        return _fitting(policy_in(tensors, meta, folder), config, tracker, folder)
    file = folder / RUN_FILE
    if not file.exists():
        hint = "Give the folder of poise train compliant"
        raise PoiseError("holds no run of the recipe compliant", folder, hint)
    config = _read(file)
    if not (folder / LATEST).exists():
        raise PoiseError("nothing was trained in it yet", folder, "Train it for some minutes")
    return _fitting(load_policy(folder / LATEST), config, tracker, folder)


def _fitting(top: PolicyBundle, config: Compliant, tracker: Tracker, folder: Path) -> Learned:
    """Refuses what was trained on another body."""
    added = config.added(tracker.policy.num_obs)
    if top.num_actions != added.width(len(tracker.humanoid.hinges)):
        raise PoiseError("it was trained on another body", folder, "Give the policy it was trained on")
    return Learned(config, top, added)


def _read(file: Path) -> Compliant:
    try:
        data = json.loads(file.read_text("utf-8"))
        return recipe.config_of(data["config"], file)
    except (ValueError, KeyError, TypeError) as problem:
        raise PoiseError("is no run file of the recipe compliant", file) from problem
