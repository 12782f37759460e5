"""The stages of a training: which follows which, how each begins, when it ends at the latest.

One network tracks all clips and then, where recovery is learned, goes on with recovery besides. Training
by stages with primitives is `papers.perpetual.primitive_stages`, another `StageOrder`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from poise.env import ImitationEnv, Recovery, Reference
from poise.env.recovery.falls import fall_states
from poise.env.recovery.get_up import GetUpPlanner
from poise.env.recovery.planner import recovery_motions
from poise.env.task import Acts
from poise.jobs.warm_start import CLONE_WORLDS, TrainingCallbacks, clone_expert, critic_first
from poise.learn import (
    CloneConfig,
    Decision,
    IterationStats,
    PolicyBundle,
    PPOConfig,
    Trainer,
    WarmStart,
)
from poise.learn.checkpoint import State
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import pushed, stage_task
from poise.recipes.perpetual_settings import Perpetual, Recovers
from poise.score import ClipResults, RecoveryCard
from poise.settings import imported
from poise.sim import UnstableError, make_backend

#: The folder in a run folder with worlds that went bad.
DUMPS = "dumps"
#: Where in the training a network that learns recovery has tracked alone at the latest, of the share
#: that `RecoveryPlan.share` leaves.
TRACKS = 0.8


Kind = Literal["primitive", "single", "joint", "recovery", "composer"]


@dataclass(frozen=True)
class Stage:
    """One training after another, see `following`.

    Attributes:
        number: counts all stages of a run from 1.
        mixed: episodes of recovery are interleaved.
    """

    kind: Kind
    number: int = 1
    mixed: bool = False

    @property
    def name(self) -> str:
        """As it is shown and noted: "primitive 2"."""
        if self.kind == "primitive":
            return f"primitive {self.number}"
        return f"{self.kind} with recovery" if self.mixed and self.kind != "composer" else self.kind

    @property
    def recovers(self) -> Recovers | None:
        """As what the stage learns recovery; None: it tracks alone."""
        if self.kind == "recovery":
            return "primitive"
        return "composer" if self.mixed else None


@dataclass(frozen=True)
class Progress:
    """Figures of one iteration.

    Attributes:
        stage: the one that was trained.
        iteration: over all stages.
        share: of the whole training, 0 to 1.
        clips: of the stage; of the recovery primitive, its trials.
        succeeded: how many of the `clips` succeeded in the last evaluation; None before the first.
        help_n: N, the help that is left on the clip that has most.
        results, recovery: evaluations that were made after this iteration.
        following: the stage that begins now.
        trouble: why training diverged before this iteration, which then was made again from the last
            checkpoint; empty without a divergence.
    """

    stage: Stage
    iteration: int
    stats: IterationStats
    share: float
    succeeded: int | None
    clips: int
    help_n: float
    results: ClipResults | None
    recovery: RecoveryCard | None
    following: Stage | None
    trouble: str = ""


#: m: demonstrations begin no farther away.
FAR = 5.0
#: Characters that fall at once.
WORLDS = 256


def demonstrations(imitation: Imitation) -> Reference:
    """As many recovery motions to one place as `RecoveryPlan.demonstrations` says."""
    config: Perpetual = imitation.config
    humanoid, recovery_clips, count = (
        imitation.humanoid,
        imitation.recovery_clips,
        config.recovering.demonstrations,
    )
    assert recovery_clips is not None
    drop, seed = Recovery.phc(config.faithful, "primitive").drop, int(config.seed)
    backend = make_backend(imitation.model, min(WORLDS, count), "cpu", threads=1)
    try:
        drop = replace(drop, count=-(-count // 2))
        falls = fall_states(backend, humanoid, imitation.task.pd, drop, seed)
    finally:
        backend.close()
    rate = imitation.reference.rate_hz
    motions = recovery_motions(
        GetUpPlanner(recovery_clips, humanoid.table, rate), falls, FAR, count, seed
    )
    return Reference(humanoid, list(motions.values()), rate, list(motions))


def practised(imitation: Imitation, stage: Stage) -> Imitation:
    """The task of a stage's characters: the library, in a stage that recovers with recovery motions
    besides, and in the stage of the recovery primitive recovery motions alone."""
    if imitation.recovery_clips is None or stage.recovers is None:
        return imitation
    shown = demonstrations(imitation)
    alone = stage.kind == "recovery"
    return replace(imitation, reference=shown if alone else imitation.reference.joined(shown))


def odds(imitation: Imitation, stage: Stage, library: Tensor, length: Tensor) -> Tensor:
    """Odds of the clips of what is `practised`, of `length (C,)` frames, from the odds `(L,)` of the
    library's: `RecoveryPlan.demonstration_share` of all episodes are recovery motions, or all are."""
    if imitation.recovery_clips is None or stage.recovers is None:
        return library
    length, share = length.cpu().double(), imitation.config.recovering.demonstration_share
    if stage.kind == "recovery":
        return length
    recovery_clips = length[len(library) :]
    return torch.cat(
        (library * (1 - share) / library.sum(), recovery_clips * share / recovery_clips.sum())
    )


def staged(imitation: Imitation, stage: Stage) -> Imitation:
    """The task of a stage: whether it knows point goals, and that what recovers learns without help and
    no success changes a composer's."""
    task = stage_task(
        imitation.config, imitation.humanoid, None if imitation.recovery_clips else stage.recovers
    )
    own = replace(imitation, task=replace(task, guide=imitation.task.guide))
    helped = stage.kind != "composer" and not stage.recovers
    return own if helped else replace(own, task=replace(own.task, help=None))


#: Control steps that the clone sees of each frame of the library, and the most in all: a step is kept as
#: 4 bytes for every number of observation and action, 3.4 kB for 20 bodies, so 2.2 GB.
PER_FRAME, MOST = 16, 640_000
#: From so many control steps on, more rounds are of more use than more steps in each.
MANY = 200_000
#: Worlds for which `CloneConfig` states its steps; in more of them fewer do.
USUAL = 512


def clone_for(
    frames: int,
    worlds: int,
    each: int = PER_FRAME,
    most: int = MOST,
    noise: tuple[float, ...] | None = None,
) -> CloneConfig:
    """The settings of cloning for a library of `frames` at the control rate, in so many `worlds`.

    Never less than `CloneConfig`'s own 56 steps in 3 rounds, which are 115,000 control steps in 512
    worlds and enough for some minutes of motion. A library of 31,000 frames gets 496,000 in 6 rounds: 4
    times as many, over which the regression takes 5 times as long.

    each, most: control steps of each frame, and in all. noise: see `CloneConfig`.
    """
    plain, wanted = CloneConfig(), min(each * frames, most)
    if wanted <= MANY:
        rounds, epochs = plain.rounds, plain.epochs
    else:
        rounds, epochs = 5, (6, 3)
    steps = ceil(wanted / ((rounds + 1) * worlds))
    least = ceil(plain.steps * min(1.0, USUAL / worlds))
    return CloneConfig(steps=max(least, steps), rounds=rounds, epochs=epochs, noise=noise or plain.noise)


class StageOrder:
    """The stages of one network: it tracks, and where recovery is learned it then learns both.

    given_first: the policy that a run goes on from is its first stage, which is over when it begins.
    """

    given_first = False

    def __init__(self, config: Perpetual):
        self.config = config

    @property
    def first(self) -> Stage:
        """The first stage of a run."""
        return Stage("single")

    def lasts(self, stage: Stage) -> bool:
        """Whether no stage follows, so that this one has all the time that is left."""
        return stage.mixed or not self.config.recovery

    def following(self, stage: Stage, fails: bool) -> Stage | None:
        """The stage after this one; None ends the training.

        fails: whether a clip failed that one primitive more could learn.
        """
        return None if self.lasts(stage) else Stage(stage.kind, stage.number + 1, mixed=True)

    def ends(self, stage: Stage, begun: float) -> float:
        """The share of the whole training at which a stage ends at the latest.

        begun: the share at which it began.
        """
        return 1.0 if self.lasts(stage) else (1.0 - self.config.recovering.share) * TRACKS

    def primitives(self, stage: Stage) -> int:
        """Primitives of tracking that were begun by this stage; 0 for one network."""
        return 0

    def is_over(self, stage: Stage, decision: Decision, share: float) -> bool:
        """Whether a stage ends of which an evaluation, made at this share of the whole training, says
        `decision`."""
        solved = decision == "solved"
        if self.lasts(stage) or (solved and self.following(stage, fails=False) is None):
            # The last stage has all the time there is.
            return solved
        # Without any time left nothing begins.
        return decision != "go on" and share < 1.0

    def most_help(self, stage: Stage, begun: float, share: float) -> float:
        """The share of the help's limits that a stage which began at `begun` may still have at `share`
        of the whole training, so that its help ends in any case."""
        span = max(1e-9, self.ends(stage, begun) - begun) * self.config.help_share
        return min(1.0, max(0.0, 1.0 - (share - begun) / span))

    def members(self, stage: Stage, hard: Tensor, imitation: Imitation) -> Tensor:
        """`(C,)` bool, the clips of a later stage. hard: what the stages before it have failed."""
        return torch.ones_like(hard)

    # --- how stages begin -----------------------------------------------------------------------

    def begin(
        self,
        imitation: Imitation,
        threads: int,
        folder: Path,
        tell: TrainingCallbacks,
        trained: PolicyBundle | WarmStart | None = None,
    ) -> tuple[Stage, WarmStart | None]:
        """The first stage, and the policy it starts from; None starts from nothing.

        Args:
            folder: of the run.
            trained: a network that goes on.
        """
        stage = self.first
        if trained is None:
            return stage, self.cloned(imitation, stage, threads, folder, tell)
        start = self.fitted(trained, imitation, stage)
        return (Stage(stage.kind, 2, mixed=True) if self.config.recovery else stage), start

    def fitted(self, trained: PolicyBundle | WarmStart, imitation: Imitation, stage: Stage) -> WarmStart:
        """A network that goes on, with as many actions as the task has, and its clipping."""
        own = staged(imitation, stage)
        env = own.env(1, threads=1)
        env.close()
        start = trained if isinstance(trained, WarmStart) else WarmStart(trained)
        policy = start.policy.with_actions(env.num_actions).clipped(own.ppo().obs_clip)
        return replace(start, policy=policy)

    def cloned(
        self,
        imitation: Imitation,
        stage: Stage,
        threads: int,
        folder: Path,
        tell: TrainingCallbacks,
        student: PolicyBundle | None = None,
    ) -> WarmStart | None:
        """A clone of the scripted expert; None without `Perpetual.expert`, or where it fails.

        student: the policy that is taught; by default a new perceptron.
        """
        if not self.config.expert:
            return None
        try:
            acts = self.expert(imitation, folder, threads, tell)
            settings = self.clone_config(imitation)
            sized = self.sized(imitation, stage)
            return clone_expert(sized, threads, folder / DUMPS, tell, settings, student, acts)
        except UnstableError as problem:
            # Clips that throw the expert off may still be learned from nothing.
            if tell.failed is not None:
                tell.failed(str(problem))
            return None

    def expert(
        self, imitation: Imitation, folder: Path, threads: int, tell: TrainingCallbacks
    ) -> Callable[[ImitationEnv], Acts] | None:
        """Makes what is cloned, in an environment; None is the scripted expert."""
        return None

    def clone_config(self, imitation: Imitation) -> CloneConfig:
        """How an expert is cloned: as the settings say, or by the frames of the library."""
        worlds = min(self.config.num_envs, CLONE_WORLDS)
        return self.config.clone or clone_for(int(imitation.reference.length.sum()), worlds)

    def next(
        self,
        before: WarmStart,
        imitation: Imitation,
        stage: Stage,
        owner: Tensor,
        threads: int,
        dumps: Path | None,
        tell: TrainingCallbacks,
    ) -> WarmStart:
        """The policy that a later stage starts from.

        Args:
            before: what the last stage learned, with its critic, which goes on.
            owner: `(C,)`, the primitive of each clip of the library.
        """
        return before

    def ppo(self, stage: Stage) -> PPOConfig:
        """The settings of PPO with the widths of the stage's network."""
        return replace(self.config.ppo, policy_hidden=self.config.single_hidden)

    def sized(self, imitation: Imitation, stage: Stage) -> Imitation:
        """The task of a stage, with the widths of its network."""
        own = staged(imitation, stage)
        return replace(own, config=replace(own.config, ppo=self.ppo(stage)))

    def trainer(
        self,
        imitation: Imitation,
        stage: Stage,
        start: WarmStart | None,
        warm: bool,
        threads: int,
        dumps: Path | None,
        device: str,
    ) -> Trainer:
        """The stage's trainer on fresh worlds, with draws of its own.

        warm: whether `start` acts already, so that the critic learns first. How large its steps are the
            settings say, see `going_on` for those of a policy that is good.
        """
        config = self.config
        # Another stage draws other starts and noise.
        seed = (config.seed + 1_000_003 * (stage.number - 1)) % 2**31
        own = staged(practised(imitation, stage), stage)
        config = replace(config, seed=seed, ppo=self.ppo(stage))
        own = replace(own, config=config, task=pushed(own.task, config, own.humanoid))
        ppo = critic_first(own.ppo()) if warm else own.ppo()
        lessons = None
        if config.teacher is not None:
            lessons = own.teacher(config.teacher, threads), config.lessons
        return own.trainer(
            threads, dumps, warm_start=start, ppo=ppo, device=device, style=config.style, lessons=lessons
        )


def order_of(config: Perpetual) -> StageOrder:
    """The order of the stages of a run with these settings."""
    return imported(config.ORDER)(config)


def critic_of(trainer: Trainer) -> State:
    """The critic of a trainer, for a `WarmStart`."""
    return {k: v for k, v in trainer.ppo.state().items() if k.startswith(("critic/", "return_norm/"))}
