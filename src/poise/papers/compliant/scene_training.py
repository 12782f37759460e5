"""Scenes learned while giving way: a policy on top of another one (Deep Compliant Control).

| paper                                     | here                                               |
|-------------------------------------------|----------------------------------------------------|
| Sec. 3 compliance-induced motion, Eq. 8   | `control.compliance`, `env.yielding`               |
| Sec. 5.3, 5.4 scenes, states and rewards  | `scenes`                                           |
| Eq. 10 r = w_imit r_imit + w_task r_task  | `task`                                             |
| Sec. 4 imitation controller               | the universal policy, with a learned one on top    |
| Sec. 4.2 state (s_dyn, u, s_task)         | `seen`: the root, u, and what the scene tells      |
| Sec. 5.4 six fictional forces as actions  | `Compliant.forces`                                 |

The paper's controller learns all of a motion from nothing by an adversarial reward, see
`imitation_controller`. Here the policy that tracks any motion follows the displaced goal, and the policy
on top learns what the scene's task asks for beside that.

run/
    compliant.json          the settings
    checkpoint.safetensors  the training as it stands, with the policy on top
    log.csv                 the learning curve
"""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast

import torch
from torch import Tensor

from poise.control import Compliance, Stiffness
from poise.env import DoneTerm, ObsTerm, TaskConfig
from poise.env import observations as obs
from poise.env.env import ImitationEnv
from poise.env.task import Acts, EnvStep
from poise.errors import PoiseError, did_you_mean
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker, halved
from poise.learn import (
    LATEST,
    IterationStats,
    PolicyBundle,
    PPOConfig,
    RunResult,
    Trainer,
    Until,
    VecEnv,
    load_policy,
    run,
)
from poise.learn.checkpoint import PolicyMeta, load_checkpoint, only_writer, save_checkpoint
from poise.learn.policy import policy_in
from poise.machine import cores, one_thread
from poise.papers.compliant import imitation_controller as terms
from poise.papers.compliant.motions import motion_of, standing
from poise.papers.compliant.scenes import SCENES, PlayScene, SceneSetup
from poise.papers.compliant.scenes.ball import FictionalForces
from poise.recipes.imitation import Imitation
from poise.settings import Migration, Range, Share, from_data, to_data, validate


@dataclass(frozen=True)
class Added:
    """What the actions of a policy on top are.

    Attributes:
        seen: observations that the policy below takes, the first ones of the environment's; the others
            are those of the one on top.
        reach: rad, what an action of 1 adds to each joint's action; 0 leaves the joints alone.
        forces: whether six more actions are fictional forces, see `scenes.ball`.
    """

    seen: int
    reach: float = 0.0
    forces: bool = False

    def width(self, hinges: int) -> int:
        """How many actions that are."""
        return (hinges if self.reach else 0) + (6 if self.forces else 0)

    def apply(self, env: ImitationEnv, below: Tensor, own: Tensor) -> Tensor:
        """The environment's actions `(N, A)`: those of the policy below and what is added to them."""
        joints = env.hinges if self.reach else 0
        if self.forces:
            forces = env.event(FictionalForces)
            assert forces is not None
            forces.asked = own[:, joints:].clone()
        if not joints:
            return below
        out = below.clone()
        out[:, :joints] += self.reach * own[:, :joints]
        return out


class OnTop:
    """An environment for a policy that is learned on top of another one; the learner's `VecEnv`.

    Args:
        env: observes what both see.
        policy: the one below, which does not change.
        added: what is learned.
    """

    def __init__(self, env: ImitationEnv, policy: Acts, added: Added):
        self.env, self.policy, self.added = env, policy, added
        self.num_envs, self.device = env.num_envs, env.device
        self.num_obs = env.num_obs - added.seen
        self.num_actions = added.width(env.hinges)
        self._seen = env.observe()[:, : added.seen].clone()

    def reset(self) -> Tensor:
        """New episodes everywhere."""
        return self._own(self.env.reset())

    @one_thread()
    def step(self, actions: Tensor) -> EnvStep:
        """One control step of both."""
        below = self.policy.act(self._seen)
        step = self.env.step(self.added.apply(self.env, below, actions))
        own = self._own(step.obs)
        return step._replace(obs=own, final_obs=step.final_obs[:, self.added.seen :].clone())

    def _own(self, obs: Tensor) -> Tensor:
        self._seen = obs[:, : self.added.seen].clone()
        return obs[:, self.added.seen :].clone()

    def state(self) -> dict[str, Tensor]:
        """That of the environment."""
        return self.env.state()

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Goes on from `state()`."""
        self.env.load_state(state)
        self._own(self.env.observe())

    def close(self) -> None:
        """Frees the worlds."""
        self.env.close()


class Topped:
    """A policy with what was learned on top of it, as one that acts on an environment's observations.

    begin: binds it to the environment, in which it sets what is no action.
    """

    def __init__(self, policy: Acts, top: Acts, added: Added):
        self._policy, self._top, self._added = policy, top, added
        self._env: ImitationEnv | None = None

    def begin(self, env: ImitationEnv) -> None:
        """Acts in an environment from now on."""
        self._env = env

    def act(self, obs: Tensor) -> Tensor:
        """Mean actions `(N, A)`."""
        assert self._env is not None
        with torch.no_grad():
            seen = self._added.seen
            own = self._top.act(obs[:, seen:])
            return self._added.apply(self._env, self._policy.act(obs[:, :seen]), own)


@dataclass(frozen=True)
class Compliant:
    """Settings of one run.

    Attributes:
        scene: which scene is learned: those with a reward of their own, ball and door.
        width: m, of the door.
        pushes: N, of pushes at the chest while the ball is balanced.
        seconds: s, how long episodes last where the scene's motion has no end of its own.
        level: level of compliance; None takes what suits the scene.
        stiffness: N/m, a commanded stiffness in place of a level.
        reach: rad, what an action of 1 adds to each joint; 0 leaves the joints to the policy below.
        forces: six fictional forces are actions, where the scene has them.
        imitation_weight: w_imit of Eq. 10.
        task_weight: w_task of Eq. 10.
        cooling: share of the training, at its end, in which the policy's step size falls evenly to a
            tenth, so that it ends as it does on average; 0 for steps of one size.
    """

    scene: str = "ball"
    width: float = 1.0
    pushes: float = 0.0
    seconds: Annotated[float, Range(0.5, 600, unit="s")] = 6.0
    level: float | None = None
    stiffness: float | None = None
    reach: Annotated[float, Range(0, math.pi, unit="rad")] = 0.0
    forces: bool = True
    imitation_weight: float = 0.5
    task_weight: float = 0.5
    cooling: Share = 0.4
    num_envs: int = 128
    seed: int = 0
    # The paper's networks. Its rate of 1e-5, its gamma of .95 and its noise of 6 degrees are not taken:
    # this learns in minutes, over 33 control steps, with a noise of .3 of what an action may add.
    ppo: PPOConfig = PPOConfig(
        policy_hidden=(256, 256, 256),
        value_hidden=(256, 256, 256),
        gamma=0.97,
        std=0.3,
        policy_lr=3e-4,
        minibatch=512,
    )

    def __post_init__(self) -> None:
        validate(self, "compliant")
        if self.scene not in LEARNED:
            hint = did_you_mean(self.scene, LEARNED)
            raise PoiseError(
                f"the scene '{self.scene}' has no reward to learn from",
                hint=hint,
                code="scene-without-reward",
            )
        if not (self.reach or self.added(0).forces):
            what = "reach must be above 0 where there are no forces to learn, got 0"
            raise PoiseError(what, "compliant", code="settings-conflict")

    def added(self, seen: int) -> Added:
        """What is learned on top of a policy that sees so many numbers."""
        return Added(seen, self.reach, self.forces and self.scene == "ball")

    def play(self) -> PlayScene:
        """The scene."""
        kind: Any = SCENES[self.scene]
        given = {"ball": {"pushes": self.pushes, "seed": self.seed}, "door": {"width": self.width}}
        return kind(**given[self.scene])

    def given(self) -> Compliance | Stiffness | None:
        """How the character gives way; None is what suits the scene."""
        if self.stiffness is not None:
            return Stiffness(self.stiffness, 0.5)
        return None if self.level is None else Compliance(self.level)


#: Scenes with a reward.
LEARNED = ("ball", "door")


def seen(stage: SceneSetup) -> tuple[ObsTerm, ...]:
    """What the policy on top sees."""
    own = (obs.root_height, obs.root_tilt, obs.root_velocity)
    u = ObsTerm("displacement", terms.displacement)
    return (*(ObsTerm(f"own/{t.__name__}", t) for t in own), u, *stage.obs)


def task(base: TaskConfig, stage: SceneSetup, config: Compliant, rate_hz: float) -> TaskConfig:
    """The task of the policy below, with what the scene adds to it (Eq. 10)."""
    imitation = tuple(replace(r, weight=config.imitation_weight * r.weight) for r in base.rewards)
    own = tuple(replace(r, weight=config.task_weight) for r in stage.rewards)
    dones: tuple[DoneTerm, ...] = (*base.dones, *stage.dones)
    return replace(
        base,
        obs=(*base.obs, *seen(stage)),
        rewards=(*imitation, *own),
        dones=dones,
        events=stage.events,
        compliance=stage.yields(config.given()),
        help_by="all",
        style=(),
        first=1.0 if stage.from_start else base.first,
        horizon=round(config.seconds * rate_hz),
        completion_bonus=0.0,
    )


def config_of(data: Mapping[str, Any], where: Path | str | None = None) -> Compliant:
    """The settings that a run holds as JSON data."""
    return from_data(Compliant, Migration()(data), where)


RECIPE: dict[str, Any] = {"name": "compliant", "config": Compliant}


#: What a run begins with.
RUN_FILE = "compliant.json"
#: What comes along on top of the policy that comes along, by scene.
SHIPPED = {"ball": Path(__file__).parents[2] / "data" / "ball.safetensors"}


@dataclass(frozen=True, eq=False)
class LearnedOnTop:
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
            raise PoiseError(
                "the folder holds a run with other settings", folder, hint, code="settings-differ"
            )
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
    own = task(made.task, stage, config, made.reference.rate_hz)
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


def save_learned(learned: LearnedOnTop, tracker: Tracker, path: Path) -> None:
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


def shipped(scene: str, tracker: Tracker) -> LearnedOnTop | None:
    """What comes along for a scene; None where there is nothing, or it belongs to another policy."""
    path = SHIPPED.get(scene)
    if path is None or load_checkpoint(path)[1]["metadata"]["below"] != digest_of(tracker.policy):
        return None
    return open_learned(path, tracker)


def open_learned(folder: Path, tracker: Tracker) -> LearnedOnTop:
    """What a run has learned so far, or the file that `save_learned` wrote.

    Raises:
        PoiseError: no run of the recipe, nothing trained yet, or a policy of another body.
    """
    if folder.is_file():
        tensors, meta = load_checkpoint(folder, PolicyMeta)
        told = meta.get("metadata", {})
        if told.get("recipe") != "compliant" or not isinstance(told.get("config"), dict):
            hint = "Give the folder of poise train compliant, or a file that was saved from it"
            raise PoiseError("holds nothing of the recipe compliant", folder, hint, code="not-a-run")
        config = config_of(told["config"], folder)
        return _fitting(policy_in(tensors, meta, folder), config, tracker, folder)
    file = folder / RUN_FILE
    if not file.exists():
        hint = "Give the folder of poise train compliant"
        raise PoiseError("holds no run of the recipe compliant", folder, hint, code="not-a-run")
    config = _read(file)
    if not (folder / LATEST).exists():
        raise PoiseError(
            "nothing was trained in it yet", folder, "Train it for some minutes", code="nothing-trained"
        )
    return _fitting(load_policy(folder / LATEST), config, tracker, folder)


def _fitting(top: PolicyBundle, config: Compliant, tracker: Tracker, folder: Path) -> LearnedOnTop:
    """Refuses what was trained on another body."""
    added = config.added(tracker.policy.num_obs)
    if top.num_actions != added.width(len(tracker.humanoid.hinges)):
        raise PoiseError(
            "it was trained on another body",
            folder,
            "Give the policy it was trained on",
            code="bodies-differ",
        )
    return LearnedOnTop(config, top, added)


def _read(file: Path) -> Compliant:
    try:
        data = json.loads(file.read_text("utf-8"))
        return config_of(data["config"], file)
    except (ValueError, KeyError, TypeError) as problem:
        raise PoiseError(
            "is no run file of the recipe compliant", file, code="wrong-file-kind"
        ) from problem
