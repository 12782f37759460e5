"""How each stage begins: from a clone of the expert, from primitives, from demonstrations."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from poise.env import ImitationEnv, Recovery, Reference
from poise.env.controls import keep_actions
from poise.env.recovery.clips import GetUpPlanner
from poise.env.recovery.clock import RecoveryClock
from poise.env.recovery.falls import fall_states
from poise.env.recovery.planner import recovery_motions
from poise.errors import PoiseError
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
    load_checkpoint,
    next_column,
    save_checkpoint,
)
from poise.learn.checkpoint import State, make_generator
from poise.learn.composer import Composer
from poise.plan import Trajectories, TrajectoryOptimizer
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import pushed, stage_task, walking_clips
from poise.recipes.perpetual_settings import Perpetual
from poise.sim import UnstableError, make_backend

if TYPE_CHECKING:
    from poise.jobs.tracker import Tracker


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
    """What a stage's characters practise: the library, in a stage that recovers with recovery motions
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


#: Control steps that the clone sees of each frame of the library, and the most in all: a step is kept as
#: 4 bytes for every number of observation and action, 3.4 kB for 20 bodies, so 2.2 GB.
PER_FRAME, MOST = 16, 640_000
#: The same for the LQR teacher: its feedback takes more to learn.
PER_FRAME_OF_PATHS, MOST_OF_PATHS = 60, 1_000_000
#: From so many control steps on, more rounds are of more use than more steps in each.
MANY = 200_000
#: Worlds for which `CloneConfig` states its steps; in more of them fewer do.
USUAL = 512


def clone_for(frames: int, worlds: int, paths: bool = False) -> CloneConfig:
    """The settings of cloning for a library of `frames` at the control rate, in so many `worlds`.

    Never less than `CloneConfig`'s own 56 steps in 3 rounds, which are 115,000 control steps in 512
    worlds and enough for some minutes of motion. A library of 31,000 frames gets 496,000 in 6 rounds: 4
    times as many, over which the regression takes 5 times as long.

    paths: the teacher is an LQR teacher on optimised trajectories and must stay near to them: less
        noise, more steps.
    """
    each, most = (PER_FRAME_OF_PATHS, MOST_OF_PATHS) if paths else (PER_FRAME, MOST)
    plain, wanted = CloneConfig(), min(each * frames, most)
    if wanted <= MANY:
        rounds, epochs = plain.rounds, plain.epochs
    else:
        rounds, epochs = 5, (6, 3)
    steps = ceil(wanted / ((rounds + 1) * worlds))
    noise = (0.0, 0.5, 1.0) if paths else plain.noise
    least = ceil(plain.steps * min(1.0, USUAL / worlds))
    return CloneConfig(steps=max(least, steps), rounds=rounds, epochs=epochs, noise=noise)


#: The file of a run folder with the trajectories of its clips, as far as they were optimised.
PATHS = "paths.safetensors"


def find_paths(
    imitation: Imitation, folder: Path, threads: int, tell: TrainingCallbacks
) -> Trajectories:
    """A trajectory for every clip; goes on with what the folder holds of an unfinished optimisation."""
    config: Perpetual = imitation.config
    assert config.trajopt is not None
    search = TrajectoryOptimizer(imitation.reference, config.sim, config.trajopt, threads)
    path, names = folder / PATHS, list(imitation.reference.names)
    if path.exists():
        state, meta = load_checkpoint(path)
        if meta.get("clips") != names or state["qpos"].shape != search.qpos.shape:
            raise PoiseError(
                "it holds trajectories of other clips",
                path,
                "Remove it, or choose another folder",
                code="clips-differ",
            )
        search.load_state(state)
    while not search.done:
        stats = search.iterate()
        save_checkpoint(path, search.state(), {"kind": "paths", "clips": names})
        if tell.path is not None:
            tell.path(stats, config.trajopt.iterations)
    return search.trajectories()


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
        owner, clock = self.owner[self.env.clip], self.env.event(RecoveryClock)
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


#: Deviation of the noise of absolute actions, which are shares of a joint's range.
STD = 0.02


class PolicyTeacher:
    """Acts in an environment as a policy would that observes it and drives its joints in its own way.

    A teacher for `poise.learn.clone`; the target angles of the joints are the same.

    Args:
        env: where the student acts; it is reset.
        tracker: the policy, on the same body and at the same control rate.

    Raises:
        PoiseError: the environment has several bodies, or another one than the policy.
    """

    def __init__(self, env: ImitationEnv, tracker: Tracker):
        if len(env.goal.bodies) > 1:
            raise PoiseError(
                "a policy teaches on its own body, and there are several shapes", code="single-body-only"
            )
        if env.goal.humanoid.identity != tracker.humanoid.identity:
            raise PoiseError(
                "the policy that teaches has another body",
                hint="Bring the clips onto its",
                code="bodies-differ",
            )
        task = stage_task(replace(tracker.config, help_start=0.0), env.goal.humanoid, None)
        # The same worlds, seen as the policy sees them.
        task = replace(task, rewards=(), dones=(), style=(), adaptive=0.0)
        self.env, self.policy = env, tracker.policy.copy().to(env.device)
        self._seen = ImitationEnv(env.goal, env.backend, task, env.substeps)

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for the worlds as they stand now; `obs` is not looked at."""
        env, seen, n = self.env, self._seen, self.env.hinges
        reference = env.reference
        now, ahead = (reference.hinges[reference.rows(env.clip, env.frame + k)].float() for k in (0, 1))
        seen.age.copy_(env.age)
        last = seen.task.pd.action(env.task.pd.target(env.action[:, :n], now), now)
        seen.action[:, :n] = torch.where(env.age[:, None] > 0, last, 0.0)
        action = self.policy.act(seen.observe())[:, :n]
        if seen.task.filter:
            kept = seen.task.filter * (env.age > 0).to(action).unsqueeze(1)
            keep_actions(action, seen.action[:, :n], kept, n)
        own = env.task.pd.action(seen.task.pd.target(action, ahead), ahead)
        return env.unfiltered(torch.nn.functional.pad(own, (0, env.num_actions - n)))


def taught_by(teacher: Perpetual, **changes: Any) -> Perpetual:
    """The settings of a policy that another teaches: the teacher's own but for `changes`. Where its goal
    is keypoints, its actions are absolute, and it keeps no filter that would delay them."""
    own: dict[str, Any] = {
        "expert": False,
        "trajopt": None,
        "help_start": 0.0,
        "teacher": None,
        "single": True,
        "multiplicative": True,
        "progressive": True,
    }
    if changes.get("goal") == "keypoints" and teacher.goal == "rotations":
        own |= {"action": "absolute", "filter": 0.0, "ppo": replace(teacher.ppo, std=STD)}
    return replace(teacher, **(own | changes))


def distilled(
    tracker: Tracker,
    imitation: Imitation,
    threads: int = 0,
    dumps: Path | None = None,
    tell: TrainingCallbacks | None = None,
    device: str = "cpu",
    worlds: int = CLONE_WORLDS,
    start: PolicyBundle | None = None,
) -> WarmStart:
    """A policy, and its critic, for `imitation` that does as a trained one does where it comes to.

    start: the policy that is taught, by default a new one; device, worlds: of the characters, of which
    there are no more than the settings name.
    """
    config: Perpetual = imitation.config
    stage = Stage("single", 2, mixed=config.recovery)
    own = staged(practised(imitation, stage), stage)
    frames = imitation.reference.length.cpu()
    worlds, ppo = min(config.num_envs, worlds), own.ppo()
    how = {"threads": threads, "dumps": dumps, "help_scale": 0.0, "device": device, "guard": False}
    env = own.env(worlds, **how)
    env.weights = odds(imitation, stage, (frames - 1).double(), own.reference.length)
    try:
        taught = clone(
            cast(VecEnv, env),
            PolicyTeacher(env, tracker),
            config.clone or clone_for(int(frames.sum()), worlds),
            replace(ppo, policy_hidden=config.single_hidden),
            config.seed,
            (tell or TrainingCallbacks()).round,
            start,
        )
    finally:
        env.close()
    return taught[0]
