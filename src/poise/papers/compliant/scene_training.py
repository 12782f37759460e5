"""Scenes learned while giving way: a policy on top of another one (Deep Compliant Control).

| paper                                     | here                                               |
|-------------------------------------------|----------------------------------------------------|
| Sec. 3 compliance-induced motion, Eq. 8   | `control.compliance`, `env.yielding`               |
| Sec. 5.3, 5.4 scenes, states and rewards  | `scenes`                                           |
| Eq. 10 r = w_imit r_imit + w_task r_task  | `task`                                             |
| Sec. 4 imitation controller               | the universal policy, with a learned one on top    |
| Eq. 11 imitation of the displaced motion  | the rewards of the policy below, `DisplacedGoal`   |
| Sec. 4.2 state (s_dyn, u, s_task)         | `seen`: root, joints, u, and what the scene tells  |
| Sec. 5.2 levels of compliance             | `Compliant.level`, drawn and seen                  |
| Sec. 5.4 six fictional forces as actions  | `Compliant.forces`                                 |

The paper's controller learns all of a motion from nothing by an adversarial reward, see
`imitation_controller`. Here the policy that tracks any motion follows the displaced goal, and the policy
on top learns what the scene's task asks for beside that: where nothing is to be done, that forces and
torques stay small after a blow (`scenes.stage.eased`), which pays by the level where levels are drawn.

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
from typing import Annotated, Any, Literal, cast

import torch
from torch import Tensor

from poise.control import Compliance, Stiffness
from poise.control.compliance import LEVEL
from poise.env import DoneTerm, ObsTerm, TaskConfig
from poise.env import observations as obs
from poise.env.env import ImitationEnv
from poise.env.frame import Frame
from poise.env.task import Acts, EnvStep
from poise.errors import PoiseError, did_you_mean
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker, halved
from poise.kinematics.rate import read_clip
from poise.learn import (
    LATEST,
    IterationStats,
    PolicyBundle,
    PPOConfig,
    RunResult,
    Trainer,
    Until,
    VecEnv,
    WarmStart,
    load_policy,
    run,
)
from poise.learn.checkpoint import PolicyMeta, load_checkpoint, only_writer, save_checkpoint
from poise.learn.policy import policy_in
from poise.machine import cores, one_thread
from poise.motion import Clip
from poise.papers.compliant import imitation_controller as terms
from poise.papers.compliant.motions import motion_of, standing
from poise.papers.compliant.opponents import weighed
from poise.papers.compliant.scenes import SCENES, Chicken, DoorScene, PlayScene, SceneSetup
from poise.papers.compliant.scenes.ball import FictionalForces
from poise.papers.compliant.scenes.body_scenes import HEAVY_KG, LIGHT_KG
from poise.papers.compliant.scenes.stage import Given, StartsOff
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
            own = torch.where(forces.ask(own[:, joints:]), own, 0.0)
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
        """New episodes everywhere, which are over at different times, so that no update is made of one
        moment of the scene alone."""
        obs, env = self.env.reset(), self.env
        ages = torch.randint(env.task.horizon, (env.num_envs,), generator=env.goal.rng)
        env.age.copy_(ages)
        return self._own(obs)

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


#: Scenes with a reward of their own, and those in which forces are to stay small.
TASKS, EASED = ("ball", "door"), ("throws", "hands", "trampoline", "chicken")
LEARNED = (*TASKS, *EASED)
#: Levels that are drawn where none is stated; rad, what an action adds where nothing else is learned.
LEVELS, REACH = (0.0, 0.2), 0.3
#: A number, or two between which each episode's is drawn.
Drawn = float | tuple[float, float]


@dataclass(frozen=True)
class Compliant:
    """Settings of one run.

    Attributes:
        scene: which scene is learned: ball, door, throws, hands, trampoline or chicken.
        policy: file or run folder of the policy below, which the command line opens; "" for the one that
            comes along.
        clip: file of the motion that is done; "" stands at ease. Door and chicken have their own.
        width: m, of the door; two numbers draw one between them for each episode, here and below. The
            motion of doors that are drawn is made for the narrowest.
        arc: share of the door's task that is paid for a hand on the knob's arc.
        length: m, of the rod that the ball is on.
        mass: kg, of that ball.
        tilt: rad, by how much the rod is tilted at first, at random.
        height: m, by which the trampoline rises for a bounce.
        players: kg, of the chicken fight's player and of its opponent, in whose place a bag comes.
        against: whether that "bag" comes, or "nobody": the player hops alone.
        pushes: N, of pushes at the chest while the ball is balanced.
        spread: how many times the scene's own spread episodes begin off the motion.
        seconds: s, how long episodes last where the scene's motion has no end of its own.
        level: level of compliance. Two numbers draw one for each episode, which the policy on top sees;
            it is then played at any. None takes what suits: ball and door have their own, the others
            draw between 0 and 0.2.
        stiffness: N/m, a commanded stiffness in place of a level.
        reach: rad, what an action of 1 adds to each joint; 0 leaves the joints to the policy below. None
            takes 0 where there are fictional forces to learn, else 0.3.
        noise: deviation of the actions of joints while they are learned, None for `ppo.std`, that of
            forces. More of it hides in the torques what is learned of them.
        body: whether a policy that moves the joints sees them, and where they are to go.
        forces: six fictional forces are actions, where the scene has them.
        imitation_weight: w_imit of Eq. 10.
        task_weight: w_task of Eq. 10.
        cooling: share of the training, at its end, in which the policy's step size falls evenly to a
            tenth, so that it ends as it does on average; 0 for steps of one size.
    """

    scene: str = "ball"
    policy: str = ""
    clip: str = ""
    width: Annotated[Drawn, Range(0.5, 3, rising=True, unit="m")] = 1.0
    arc: Share = 0.5
    length: Annotated[Drawn, Range(0.1, 5, rising=True, unit="m")] = (0.8, 1.2)
    mass: Annotated[Drawn, Range(0.01, 50, rising=True, unit="kg")] = (0.25, 1.0)
    tilt: Annotated[float, Range(0, 1, below=True, unit="rad")] = 0.1
    height: Annotated[Drawn, Range(0, 1, rising=True, unit="m")] = (0.05, 0.2)
    players: Annotated[tuple[float, float], Range(2, 500, unit="kg")] = (HEAVY_KG, LIGHT_KG)
    against: Literal["bag", "nobody"] = "bag"
    pushes: float = 0.0
    spread: Annotated[float, Range(0, 10)] = 1.0
    seconds: Annotated[float, Range(0.5, 600, unit="s")] = 6.0
    level: Annotated[Drawn | None, replace(LEVEL, rising=True)] = None
    stiffness: Annotated[float | None, Range(0, above=True, unit="N/m")] = None
    reach: Annotated[float | None, Range(0, math.pi, unit="rad")] = None
    noise: Annotated[float | None, Range(0, 1, above=True)] = 0.1
    body: bool = True
    forces: bool = True
    imitation_weight: float = 0.5
    task_weight: float = 0.5
    cooling: Share = 0.4
    num_envs: int = 512
    seed: int = 0
    # The paper's networks. Its rate of 1e-5, its gamma of .95 and its noise of 6 degrees are not taken:
    # this learns in minutes, over 33 control steps, with a noise of .3 of what a force may add and less
    # of what is added to a joint. A critic that knows nothing yet would undo what stands already.
    ppo: PPOConfig = PPOConfig(
        policy_hidden=(256, 256, 256),
        value_hidden=(256, 256, 256),
        gamma=0.97,
        std=0.3,
        policy_lr=1e-4,
        minibatch=1024,
        critic_warmup=4,
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
        if self.clip and self.scene in ("door", "chicken"):
            raise PoiseError(
                f"the scene '{self.scene}' has a motion of its own",
                "compliant",
                "Leave the clip out",
                code="settings-conflict",
            )
        if not (self.added(0).reach or self.added(0).forces):
            what = "reach must be above 0 where there are no forces to learn, got 0"
            raise PoiseError(what, "compliant", code="settings-conflict")

    def added(self, seen: int) -> Added:
        """What is learned on top of a policy that sees so many numbers."""
        forces = self.forces and self.scene == "ball"
        return Added(seen, (0.0 if forces else REACH) if self.reach is None else self.reach, forces)

    def learner(self, hinges: int) -> PPOConfig:
        """PPO's settings, with the noise of each action."""
        added, std = self.added(0), self.ppo.std
        if not added.reach or self.noise is None or not isinstance(std, float | int):
            return self.ppo
        return replace(self.ppo, std=(self.noise,) * hinges + (float(std),) * (added.width(0)))

    def play(self) -> PlayScene:
        """The scene."""
        kind: Any = SCENES[self.scene]
        length, mass, width = (_between(x) for x in (self.length, self.mass, self.width))
        own, weight = self.players
        given = {
            "ball": {
                "lengths": length,
                "masses": mass,
                "spread": self.tilt,
                "pushes": self.pushes,
                "seed": self.seed,
            },
            "door": {
                "width": width[0],
                "arc": self.arc,
                **({"widths": width, "made_for": width[0]} if width[0] < width[1] else {}),
            },
            "chicken": {"mass": own, "other": weight, "against": self.against, "seed": self.seed},
            "throws": {"seed": self.seed},
            "trampoline": {"heights": _between(self.height)},
        }
        return kind(**given.get(self.scene, {}))

    @property
    def drawn(self) -> tuple[float, float] | None:
        """The levels between which each episode's is drawn; None where there is one."""
        if self.stiffness is not None:
            return None
        level = LEVELS if self.level is None and self.scene in EASED else self.level
        return level if isinstance(level, tuple) else None

    def suits(self, scene: PlayScene) -> PlayScene | None:
        """A scene as it was learned, None where it was not: hopping alone or not, and of doors their
        widths, by the motion for the narrowest, which a door without a motion of its own gets."""
        if isinstance(scene, Chicken):
            return scene if (scene.against == "nobody") == (self.against == "nobody") else None
        if not isinstance(scene, DoorScene):
            return scene
        low, high = _between(self.width)
        motion = scene.made_for in (None, low) and low <= scene.width <= high
        return replace(scene, made_for=low) if motion else None

    def given(self) -> Given | None:
        """How the character gives way while it learns; None is what suits the scene."""
        if self.stiffness is not None:
            return Stiffness(self.stiffness, 0.5)
        if self.drawn is not None:
            return Compliance(self.drawn[1], drawn=self.drawn)
        return None if self.level is None else Compliance(cast(float, self.level))

    def played(self, asked: Given | None) -> Given | None:
        """How it gives way where it is played: by the level that is asked for, where it has learned
        several, else as it has learned to.

        Raises:
            PoiseError: something else is asked for than it has learned.
        """
        own = self.given()
        if self.drawn is None and asked in (None, own):
            return own
        if self.drawn is None:
            raise PoiseError(
                "a run gives way as it has learned to",
                hint="Leave --level, --stiffness out",
                code="option-not-applicable",
            )
        if isinstance(asked, Stiffness):
            raise PoiseError(
                "the run has learned levels of compliance, no stiffness",
                hint="Give --level in place of --stiffness",
                code="option-not-applicable",
            )
        return asked or Compliance()


def _between(given: Drawn) -> tuple[float, float]:
    return given if isinstance(given, tuple) else (given, given)


def seen(stage: SceneSetup, config: Compliant) -> tuple[ObsTerm, ...]:
    """What the policy on top sees."""
    own = [obs.root_height, obs.root_tilt, obs.root_velocity]
    if config.body and config.added(0).reach:
        own += [obs.joint_angles, obs.joint_velocities, obs.target_joints]
    u = ObsTerm("displacement", terms.displacement)
    level = () if config.drawn is None else (ObsTerm("level", level_seen),)
    return (*(ObsTerm(f"own/{t.__name__}", t) for t in own), u, *level, *stage.obs)


def level_seen(frame: Frame) -> Tensor:
    """The level of compliance as a share of the paper's 0.2 `(N, 1)`."""
    return (frame.source("compliance/level") / LEVELS[1]).float().unsqueeze(1)


def task(base: TaskConfig, stage: SceneSetup, config: Compliant, rate_hz: float) -> TaskConfig:
    """The task of the policy below, with what the scene adds to it (Eq. 10)."""
    imitation = tuple(replace(r, weight=config.imitation_weight * r.weight) for r in base.rewards)
    share = config.task_weight / sum(r.weight for r in stage.rewards)
    most = {} if config.drawn is None or config.scene in TASKS else {"most": LEVELS[1]}
    own = tuple(replace(r, weight=share * r.weight, params={**r.params, **most}) for r in stage.rewards)
    dones: tuple[DoneTerm, ...] = (*base.dones, *stage.dones)
    gamma, stands = config.ppo.gamma, not config.clip
    off = (StartsOff(config.play().starts.times(config.spread)),) if config.spread else ()
    return replace(
        base,
        obs=(*base.obs, *seen(stage, config)),
        rewards=(*imitation, *own),
        dones=dones,
        events=(*off, *stage.events),
        compliance=stage.yields(config.given()),
        help_by="all",
        style=(),
        first=1.0 if stage.from_start or stands else base.first,
        horizon=round(config.seconds * rate_hz),
        # A ball that falls and a door that is open end their tasks; elsewhere the character goes on.
        completion_bonus=0.0 if config.scene in TASKS else gamma / (1.0 - gamma),
    )


#: The settings of earlier versions' runs, which do not name them.
_MIGRATION = Migration(
    absent={
        "against": "bag",
        "arc": 0.0,
        "length": 1.0,
        "mass": 0.5,
        "tilt": 0.02,
        "spread": 0.0,
        "body": False,
        "noise": None,
    }
)


def config_of(data: Mapping[str, Any], where: Path | str | None = None) -> Compliant:
    """The settings that a run holds as JSON data."""
    return from_data(Compliant, _MIGRATION(data), where)


RECIPE: dict[str, Any] = {"name": "compliant", "config": Compliant}


#: What a run begins with.
RUN_FILE = "compliant.json"
#: What comes along on top of the policy that comes along, by its name.
SHIPPED = {
    name: Path(__file__).parents[2] / "data" / f"{name}.safetensors"
    for name in ("ball", "chicken", "door", "hands", "hops")
}


@dataclass(frozen=True, eq=False)
class LearnedOnTop:
    """What was learned on top of a policy.

    Attributes:
        config: its settings.
        top: the policy.
        added: what its actions are.
        below: the digest of the policy that it was learned on; None of earlier versions' runs.
    """

    config: Compliant
    top: PolicyBundle
    added: Added
    below: str | None = None

    def check(self, tracker: Tracker) -> None:
        """Refuses to act on another policy than it was learned on.

        Raises:
            PoiseError: the policies' weights differ.
        """
        if self.below is None or self.below == digest_of(tracker.policy):
            return
        raise PoiseError(
            f"what was learned of {self.config.scene} lies on another policy",
            hint="Give the policy that it was trained on, or train on with poise train compliant "
            f"{self.config.scene} --from RUN",
            code="policies-differ",
        )

    def over(self, tracker: Tracker, env: ImitationEnv) -> Topped:
        """Both policies as one that acts in an environment, which observes what `seen` says."""
        self.check(tracker)
        topped = Topped(tracker.policy, self.top, self.added)
        topped.begin(env)
        return topped


def begin(folder: Path, config: Compliant, below: str) -> Compliant:
    """Writes the run file, or reads that of the run that is there.

    below: the digest of the policy that is learned on.

    Raises:
        PoiseError: the folder holds a run with other settings, or on another policy.
    """
    file = folder / RUN_FILE
    if file.exists():
        held, known = _read(file)
        if held != config:
            hint = "Resume it as it is or choose another folder"
            raise PoiseError(
                "the folder holds a run with other settings", folder, hint, code="settings-differ"
            )
        if known not in (None, below):
            raise PoiseError(
                "the folder holds a run on another policy",
                folder,
                "Give the policy of --policy that it began with, or choose another folder",
                code="policies-differ",
            )
        return held
    folder.mkdir(parents=True, exist_ok=True)
    told = {"recipe": "compliant", "config": to_data(config), "below": below}
    file.write_text(json.dumps(told, indent=1) + "\n")
    return config


#: Hz, at most, of the physics while a scene is learned: at its own rate there are few samples.
LEARNS_HZ = 120.0


def at_rate(scene: PlayScene, tracker: Tracker, most: float = math.inf) -> Tracker:
    """The policy at the rate of a scene's physics, up to `most` Hz, where that is above its own."""
    own, rate = tracker.config.sim, min(scene.rate_hz or 0.0, most)
    if rate <= own.rate_hz:
        return tracker
    return replace(tracker, config=replace(tracker.config, sim=replace(own, rate_hz=rate)))


def set_up(
    scene: PlayScene, tracker: Tracker, seconds: float, clip: Clip | None = None
) -> tuple[Imitation, SceneSetup]:
    """A scene around a policy's body, and its motion: its own one, a clip, or standing for so long."""
    clip = motion_of(scene, tracker, seconds) or clip
    made = standing(tracker, seconds) if clip is None else imitation_of(tracker, [place(clip, tracker)])
    if isinstance(scene, Chicken):
        made = weighed(made, scene.mass)
    stage = scene.stage(made.humanoid, made.reference)
    whole = {"props": stage.props, "links": stage.links, "touches": stage.touches, "floor": stage.floor}
    return replace(made, **whole), stage


def scene_task(config: Compliant, tracker: Tracker) -> Imitation:
    """The scene as a task of the tracker's body, with all that a policy on top sees and is paid."""
    scene = config.play()
    clip = read_clip(config.clip) if config.clip else None
    made, stage = set_up(scene, at_rate(scene, tracker, LEARNS_HZ), config.seconds + 0.1, clip)
    return replace(made, task=task(made.task, stage, config, made.reference.rate_hz))


def train(
    config: Compliant,
    tracker: Tracker,
    folder: Path,
    until: Until,
    on_iteration: Callable[[IterationStats], bool | None] | None = None,
    threads: int = 0,
    tensorboard: bool = True,
    earlier: LearnedOnTop | None = None,
) -> RunResult:
    """Trains until a limit; goes on where a run of the folder stopped, and a new one from what was
    learned `earlier`, on a policy that another one has replaced.

    Raises:
        PoiseError: the folder holds a run with other settings, or what was learned earlier sees or does
            something else.
    """
    task = scene_task(config, tracker)
    env = task.env(config.num_envs, config.seed, threads=threads, help_scale=0.0, guard=False)
    on_top = OnTop(env, tracker.policy, config.added(tracker.policy.num_obs))
    sizes = on_top.num_obs, on_top.num_actions
    if earlier is not None and (earlier.top.num_obs, earlier.top.num_actions) != sizes:
        on_top.close()
        raise PoiseError(
            f"what was learned of {earlier.config.scene} sees or does other things than it would here",
            folder,
            "State the settings by which it was learned",
            code="policy-unfit",
        )
    begin(folder, config, digest_of(tracker.policy))
    with only_writer(folder):
        trainer = Trainer(
            cast(VecEnv, on_top), config.learner(env.hinges), config.seed,
            task.humanoid.identity, {"recipe": "compliant"}, update_threads=threads or cores(),
            warm_start=None if earlier is None else WarmStart(earlier.top),
        )  # fmt: skip
        try:
            return run(trainer, until, folder, 10, on_iteration, tensorboard, config.cooling)
        finally:
            trainer.close()


def save_learned(learned: LearnedOnTop, tracker: Tracker, path: Path) -> None:
    """Writes what was learned on top of a policy as one file, its matrices in half precision, its clip
    by the file's name alone."""
    config = replace(learned.config, clip=Path(learned.config.clip).name)
    meta = {
        "kind": "policy", **learned.top.identity(tracker.humanoid.identity),
        "metadata": {
            "recipe": "compliant", "config": to_data(config), "below": digest_of(tracker.policy)
        },
    }  # fmt: skip
    save_checkpoint(path, {k: halved(k, v) for k, v in learned.top.state().items()}, meta)


def digest_of(policy: PolicyBundle) -> str:
    """16 hexadecimal digits that tell one policy's weights from another's."""
    told = hashlib.sha256()
    for name, value in sorted(policy.state().items()):
        told.update(name.encode() + value.contiguous().numpy().tobytes())
    return told.hexdigest()[:16]


def shipped(name: str, tracker: Tracker) -> LearnedOnTop | None:
    """What comes along by that name; None where there is nothing, or it belongs to another policy."""
    path = SHIPPED.get(name)
    if path is None or load_checkpoint(path)[1]["metadata"]["below"] != digest_of(tracker.policy):
        return None
    return open_learned(path, tracker)


def along(scene: PlayScene, tracker: Tracker) -> LearnedOnTop | None:
    """What comes along for a scene as it is; None where nothing has learned it."""
    for name in SHIPPED:
        top = shipped(name, tracker)
        if top is None or not isinstance(scene, SCENES[top.config.scene]):
            continue
        if top.config.suits(scene) is not None:
            return top
    return None


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
        below = str(told["below"]) if "below" in told else None
        return _fitting(policy_in(tensors, meta, folder), config, tracker, folder, below)
    file = folder / RUN_FILE
    if not file.exists():
        hint = "Give the folder of poise train compliant"
        raise PoiseError("holds no run of the recipe compliant", folder, hint, code="not-a-run")
    config, below = _read(file)
    if not (folder / LATEST).exists():
        raise PoiseError(
            "nothing was trained in it yet", folder, "Train it for some minutes", code="nothing-trained"
        )
    return _fitting(load_policy(folder / LATEST), config, tracker, folder, below)


def _fitting(
    top: PolicyBundle, config: Compliant, tracker: Tracker, folder: Path, below: str | None
) -> LearnedOnTop:
    """Refuses what was trained on another body."""
    added = config.added(tracker.policy.num_obs)
    if top.num_actions != added.width(len(tracker.humanoid.hinges)):
        raise PoiseError(
            "it was trained on another body",
            folder,
            "Give the policy it was trained on",
            code="bodies-differ",
        )
    return LearnedOnTop(config, top, added, below)


def _read(file: Path) -> tuple[Compliant, str | None]:
    """The settings of a run, and the digest of the policy that it learns on, where it is known."""
    try:
        data = json.loads(file.read_text("utf-8"))
        return config_of(data["config"], file), data.get("below")
    except (ValueError, KeyError, TypeError) as problem:
        raise PoiseError(
            "is no run file of the recipe compliant", file, code="wrong-file-kind"
        ) from problem
