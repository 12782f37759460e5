"""How each stage begins: from a clone of the expert, from the primitive before, from all primitives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.env.recovery.clock import RecoveryClock
from poise.jobs.perpetual.demonstrations import clone_for, find_paths, odds, practised
from poise.jobs.perpetual.stage_order import Stage, first_recovers, first_stage, own_recovery
from poise.jobs.warm_start import CLONE_WORLDS, TrainingCallbacks, clone_expert, critic_first
from poise.learn import (
    CloneConfig,
    PolicyBundle,
    PPOConfig,
    Trainer,
    VecEnv,
    WarmStart,
    clone,
    columns_of,
    compose,
    first_column,
    next_column,
)
from poise.learn.state import State, make_generator
from poise.nets import Composer
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.recovery import walking_clips
from poise.recipes.perpetual.task import Perpetual, pushed, stage_task
from poise.sim import UnstableError

#: The folder in a run folder with worlds that went bad.
DUMPS = "dumps"


def begin_first(
    imitation: Imitation,
    threads: int,
    folder: Path,
    tell: TrainingCallbacks,
    trained: PolicyBundle | WarmStart | None = None,
) -> tuple[Stage, WarmStart | None]:
    """The first stage, and the policy it starts from; None starts a single network from nothing.

    Args:
        folder: of the run, where the trajectory optimisation is kept.
        trained: a single network that goes on. As a first primitive that recovers already it is done:
            its stage is over when it begins.
    """
    config: Perpetual = imitation.config
    stage = first_stage(config)
    own = staged(imitation, stage)
    if trained is not None:
        env = own.env(1, threads=1)
        env.close()
        start = trained if isinstance(trained, WarmStart) else WarmStart(trained)
        policy = start.policy.with_actions(env.num_actions).clipped(own.ppo().obs_clip)
        start = replace(start, policy=policy)
        if not config.recovery:
            return stage, start
        if stage.kind == "single":
            return Stage("single", 2, mixed=True), start
        # What is trained already is the first primitive.
        known = replace(start, policy=columns_of(start.policy, config.lateral))
        if first_recovers(config):
            return stage, known
        second = Stage("recovery", 2)
        return second, begin_primitive(known, imitation, second)
    sized = replace(own, config=replace(config, ppo=_sized(config, stage)))
    joint = _joint(sized) if stage.kind == "joint" else None
    start = None
    if config.expert:
        try:
            paths = find_paths(imitation, folder, threads, tell) if config.trajopt else None
            how = (threads, folder / DUMPS, tell, clone_config(imitation), joint, paths)
            start = clone_expert(sized, *how)
        except UnstableError as problem:
            # Clips that throw the expert off may still be learned from nothing.
            if tell.failed is not None:
                tell.failed(str(problem))
    if stage.kind == "single":
        return stage, start
    if joint is not None:
        return stage, start or WarmStart(joint)
    if start is not None:
        return stage, replace(start, policy=columns_of(start.policy, config.lateral))
    return stage, WarmStart(_first_column(sized))


def _first_column(sized: Imitation) -> PolicyBundle:
    config, ppo, env = sized.config, sized.ppo(), sized.env(1, threads=1)
    env.close()
    std = ppo.std if isinstance(ppo.std, tuple) else float(ppo.std)
    sizes = (env.num_obs, env.num_actions, ppo.policy_hidden, ppo.activation, std, config.lateral)
    rng = make_generator(config.seed, "primitive 1")
    return first_column(*sizes, obs_clip=ppo.obs_clip, generator=rng)


def _joint(sized: Imitation) -> PolicyBundle:
    """All primitives and their composer, untrained: MCP without progressive training."""
    config, columns = sized.config, _first_column(sized)
    for k in range(2, config.max_primitives + 1):
        rng = make_generator(config.seed, f"primitive {k}")
        columns = next_column(columns, "random", generator=rng)
    rng, hidden = make_generator(config.seed, "composer"), config.composer_hidden
    return compose(columns, "product", config.weights, hidden, joint=True, generator=rng)


def begin_stage(
    before: WarmStart, imitation: Imitation, stage: Stage, owner: Tensor, threads: int,
    dumps: Path | None, tell: TrainingCallbacks,
) -> WarmStart:  # fmt: skip
    """What a later stage starts from: one primitive more, a composer, or the same network.

    Args:
        before: what the last stage learned, with its critic, which goes on.
        owner: see `begin_composer`.
    """
    if stage.kind == "composer":
        return begin_composer(before, imitation, stage, owner, threads, dumps, tell)
    if stage.kind in ("primitive", "recovery"):
        return begin_primitive(before, imitation, stage)
    return before


def members_of(stage: Stage, hard: Tensor, imitation: Imitation) -> Tensor:
    """`(C,)` bool, the clips of a later stage. hard: what the primitives before it have failed."""
    if stage.kind == "recovery":
        return walking_clips(imitation.reference)
    return hard if stage.kind == "primitive" else torch.ones_like(hard)


def begin_primitive(before: WarmStart, imitation: Imitation, stage: Stage) -> WarmStart:
    """One primitive more; the critic goes on, as in the paper. One that recovers is a copy of the one
    before it where that tracks recovery motions."""
    config: Perpetual = imitation.config
    copied = stage.kind == "recovery" and imitation.recovery_clips is not None
    rng = make_generator(config.seed, f"primitive {stage.number}")
    start = "copy" if copied else config.start
    return replace(before, policy=next_column(before.policy, start, generator=rng))


def begin_composer(
    before: WarmStart, imitation: Imitation, stage: Stage, owner: Tensor, threads: int,
    dumps: Path | None, tell: TrainingCallbacks,
) -> WarmStart:  # fmt: skip
    """The composer over all primitives, taught at first to do as the primitive that learned the clip,
    and as the recovery primitive on recovery motions and for characters that are far.

    owner: `(C,)`, the primitive of each clip of the library.
    """
    config, own = imitation.config, staged(practised(imitation, stage), stage)
    rng = make_generator(config.seed, "composer")
    parts = (config.combine, config.weights, config.composer_hidden, config.ppo.std)
    combine, weights, hidden, std = parts
    std = float(std) if isinstance(std, float | int) else 0.1
    policy = compose(before.policy, combine, weights, hidden, std, generator=rng)
    if not config.composer_clone:
        return replace(before, policy=policy)
    env = own.env(min(config.num_envs, CLONE_WORLDS), threads=threads, dumps=dumps, help_scale=0.0)
    seconds = (imitation.reference.length.cpu() - 1).double()
    env.weights = odds(imitation, stage, seconds, own.reference.length)
    # Choosing among primitives is learned sooner than acting; the critic goes on from them.
    settings = clone_config(imitation)
    settings = replace(settings, rounds=min(1, settings.rounds), critic_steps=0)
    try:
        taught, _ = clone(
            cast(VecEnv, env), Owners(env, policy, owner, own_recovery(config)), settings,
            imitation.ppo(), config.seed, tell.round, policy,
        )  # fmt: skip
    except UnstableError as problem:
        if tell.failed is not None:
            tell.failed(str(problem))
        return replace(before, policy=policy)
    finally:
        env.close()
    cost = {"samples": before.samples + taught.samples, "seconds": before.seconds + taught.seconds}
    return replace(before, policy=taught.policy, **cost)


class Owners:
    """Acts for each world as the primitive that learned its clip: a teacher for the composer.

    On clips that `owner` does not name, which are recovery motions, the recovery primitive acts: the
    last one, or without one of its `own` the first. Where the task knows point goals, the recovery
    primitive also acts for a character that is so far from the reference, or fallen below it, that its
    goal is a point, which is what the composer can see.

    Args:
        owner: `(C,)`, the primitive of each clip of the library.
        own: recovery has a primitive of its own.
    """

    def __init__(self, env: ImitationEnv, policy: PolicyBundle, owner: Tensor, own: bool = True):
        assert isinstance(policy.policy, Composer)
        self.env, self.norm, self.primitives = env, policy.norm, policy.policy.primitives
        self.recovers = own * (len(self.primitives) - 1)
        motions = owner.new_full((len(env.reference.length) - len(owner),), self.recovers)
        self.owner = torch.cat((owner, motions)).to(env.device)

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Mean actions `(N, A)` for raw observations `(N, O)` of the worlds as they stand."""
        actions = self.primitives.all(self.norm.forward(obs))
        owner, clock = self.owner[self.env.clip], self.env.plugin(RecoveryClock)
        if clock is not None:
            far = clock.before > clock.config.switch
            owner = torch.where(far, self.recovers, owner)
        return actions[torch.arange(len(obs), device=obs.device), owner]


def make_trainer(
    imitation: Imitation, stage: Stage, start: WarmStart | None, warm: bool, threads: int,
    dumps: Path | None, device: str,
) -> Trainer:  # fmt: skip
    """The stage's trainer on fresh worlds, with draws of its own.

    warm: whether `start` acts already, so that the critic learns first. How large its steps are the
        settings say, see `going_on` for those of a policy that is good.
    """
    config: Perpetual = imitation.config
    # Another stage draws other starts and noise.
    seed = (config.seed + 1_000_003 * (stage.number - 1)) % 2**31
    own = staged(practised(imitation, stage), stage)
    config = replace(config, seed=seed, ppo=_sized(config, stage))
    own = replace(own, config=config, task=pushed(own.task, config, own.humanoid))
    ppo = critic_first(own.ppo()) if warm else own.ppo()
    lessons = None
    if config.teacher is not None:
        lessons = own.teacher(config.teacher, threads), config.lessons
    return own.trainer(
        threads, dumps, warm_start=start, ppo=ppo, device=device, style=config.style, lessons=lessons
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


def clone_config(imitation: Imitation) -> CloneConfig:
    """How an expert is cloned: as the settings say, or by the frames of the library."""
    config: Perpetual = imitation.config
    worlds = min(config.num_envs, CLONE_WORLDS)
    return config.clone or clone_for(
        int(imitation.reference.length.sum()), worlds, config.trajopt is not None
    )


def critic_of(trainer: Trainer) -> State:
    """The critic of a trainer, for a `WarmStart`."""
    return {k: v for k, v in trainer.ppo.state().items() if k.startswith(("critic/", "return_norm/"))}


def _sized(config: Perpetual, stage: Stage) -> PPOConfig:
    if not config.single or stage.kind != "single":
        return config.ppo
    return replace(config.ppo, policy_hidden=config.single_hidden)
