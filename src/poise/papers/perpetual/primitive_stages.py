"""The stages of a training with primitives (PHC, Alg. 1): which follows which, and how each begins.

    primitive 1 on all clips -> primitive k on what still fails -> recovery -> composer on all clips

| `StagedPerpetual`      | stages                                                                      |
|------------------------|-----------------------------------------------------------------------------|
| as it is               | primitive 1 .. K, recovery, composer with recovery interleaved              |
| no recovery            | primitive 1 .. K, composer; primitive 1 alone where nothing fails any more  |
| the first can recover  | the same, the composer with recovery interleaved                            |
| no progressive         | joint (K primitives and composer together), joint with recovery             |
| no multiplicative      | single (of a primitive's size), single with recovery                        |
| single                 | single, single with recovery                                                |

A network with recovery is the same one as before, which goes on learning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.env.recovery.clock import RecoveryClock
from poise.env.task import Acts
from poise.errors import PoiseError
from poise.jobs.perpetual.stages import Stage, StageOrder, clone_for, odds, practised, staged
from poise.jobs.warm_start import CLONE_WORLDS, TrainingCallbacks
from poise.learn import (
    CloneConfig,
    PolicyBundle,
    PPOConfig,
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
from poise.learn.checkpoint import make_generator
from poise.learn.composer import Composer
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.papers.perpetual.trajopt import LqrTeacher, Trajectories, TrajectoryOptimizer
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import walking_clips
from poise.sim import UnstableError

#: Networks that learn all clips in one stage.
WHOLE = ("single", "joint")
#: Control steps that the clone of the LQR teacher sees of each frame, and the most in all, and the noise
#: of its rounds: its feedback takes more to learn and must stay near to the trajectories.
PER_FRAME, MOST, NOISE = 60, 1_000_000, (0.0, 0.5, 1.0)


class PrimitiveOrder(StageOrder):
    """The stages of primitives and a composer; of one network where the settings say so."""

    config: StagedPerpetual

    def __init__(self, config: StagedPerpetual):
        super().__init__(config)

    @property
    def given_first(self) -> bool:
        """Whether the first primitive is a policy that goes on and can recover already."""
        return self.config.recovery and self.config.recovering.primitive == "first"

    @property
    def own_recovery(self) -> bool:
        """Whether recovery is learned by a primitive of its own, or by one network after tracking."""
        return self.config.recovery and self.config.recovering.primitive == "own"

    @property
    def first(self) -> Stage:
        """The first stage of a run."""
        if self.config.single or not self.config.multiplicative:
            return Stage("single")
        return Stage("primitive" if self.config.progressive else "joint")

    def lasts(self, stage: Stage) -> bool:
        """Whether no stage follows."""
        if stage.kind == "composer" or stage.mixed:
            return True
        if stage.kind in WHOLE:
            return not self.config.recovery
        alone = self.config.max_primitives == 1 and not self.own_recovery
        return stage.kind == "primitive" and alone

    def following(self, stage: Stage, fails: bool) -> Stage | None:
        """The stage after this one; None ends the training."""
        number = stage.number + 1
        if self.lasts(stage) or stage.kind in WHOLE:
            return super().following(stage, fails)
        if stage.kind == "primitive":
            if fails and stage.number < self.config.max_primitives:
                return Stage("primitive", number)
            if self.own_recovery:
                return Stage("recovery", number)
            if not fails and stage.number == 1:
                return None
        return Stage("composer", number, mixed=self.config.recovery)

    def ends(self, stage: Stage, begun: float) -> float:
        """The share of the whole training at which a stage ends at the latest. Time that the primitives
        leave over is shared by recovery and composer as the rest would be."""
        if self.lasts(stage):
            return 1.0
        share = self.config.recovering.share if self.own_recovery else 0.0
        first, last = ((1.0 - share) * x for x in self.config.shares)
        if stage.kind == "recovery":
            return begun + (1.0 - begun) * share / (1.0 - last)
        if stage.kind in WHOLE or self.config.max_primitives == 1:
            return last
        return first + (last - first) * (stage.number - 1) / (self.config.max_primitives - 1)

    def primitives(self, stage: Stage) -> int:
        """Primitives of tracking that were begun by this stage; 0 for a network that learns all at
        once."""
        if stage.kind == "primitive":
            return stage.number
        if stage.kind == "recovery":
            return stage.number - 1
        # Before a composer comes the primitive of recovery, if there is one.
        return stage.number - 1 - self.own_recovery if stage.kind == "composer" else 0

    def members(self, stage: Stage, hard: Tensor, imitation: Imitation) -> Tensor:
        """`(C,)` bool, the clips of a later stage."""
        if stage.kind == "recovery":
            return walking_clips(imitation.reference)
        return hard if stage.kind == "primitive" else torch.ones_like(hard)

    # --- how stages begin -----------------------------------------------------------------------

    def begin(
        self,
        imitation: Imitation,
        threads: int,
        folder: Path,
        tell: TrainingCallbacks,
        trained: PolicyBundle | WarmStart | None = None,
    ) -> tuple[Stage, WarmStart | None]:
        """The first stage, and the policy it starts from; None starts a single network from nothing.

        trained: a single network that goes on. As a first primitive that recovers already it is done:
            its stage is over when it begins.
        """
        config, stage = self.config, self.first
        if stage.kind == "single":
            return super().begin(imitation, threads, folder, tell, trained)
        if trained is not None:
            start = self.fitted(trained, imitation, stage)
            if not config.recovery:
                return stage, start
            # What is trained already is the first primitive.
            known = replace(start, policy=columns_of(start.policy, config.lateral))
            if self.given_first:
                return stage, known
            second = Stage("recovery", 2)
            return second, self.primitive(known, imitation, second)
        sized = self.sized(imitation, stage)
        joint = _joint(sized) if stage.kind == "joint" else None
        start = self.cloned(imitation, stage, threads, folder, tell, joint)
        if joint is not None:
            return stage, start or WarmStart(joint)
        if start is not None:
            return stage, replace(start, policy=columns_of(start.policy, config.lateral))
        return stage, WarmStart(_first_column(sized))

    def expert(
        self, imitation: Imitation, folder: Path, threads: int, tell: TrainingCallbacks
    ) -> Callable[[ImitationEnv], Acts] | None:
        """Makes the LQR teacher of optimised trajectories; None is the scripted expert."""
        if not self.config.trajopt:
            return None
        paths = find_paths(imitation, folder, threads, tell)
        return lambda env: LqrTeacher(env, paths)

    def clone_config(self, imitation: Imitation) -> CloneConfig:
        """How an expert is cloned."""
        if self.config.trajopt is None or self.config.clone is not None:
            return super().clone_config(imitation)
        worlds = min(self.config.num_envs, CLONE_WORLDS)
        return clone_for(int(imitation.reference.length.sum()), worlds, PER_FRAME, MOST, NOISE)

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
        """What a later stage starts from: one primitive more, a composer, or the same network."""
        if stage.kind == "composer":
            return self.composer(before, imitation, stage, owner, threads, dumps, tell)
        if stage.kind in ("primitive", "recovery"):
            return self.primitive(before, imitation, stage)
        return before

    def ppo(self, stage: Stage) -> PPOConfig:
        """The settings of PPO with the widths of the stage's network."""
        return super().ppo(stage) if self.config.single and stage.kind == "single" else self.config.ppo

    def primitive(self, before: WarmStart, imitation: Imitation, stage: Stage) -> WarmStart:
        """One primitive more; the critic goes on, as in the paper. One that recovers is a copy of the
        one before it where that tracks recovery motions."""
        config = self.config
        copied = stage.kind == "recovery" and imitation.recovery_clips is not None
        rng = make_generator(config.seed, f"primitive {stage.number}")
        start = "copy" if copied else config.start
        return replace(before, policy=next_column(before.policy, start, generator=rng))

    def composer(
        self,
        before: WarmStart,
        imitation: Imitation,
        stage: Stage,
        owner: Tensor,
        threads: int,
        dumps: Path | None,
        tell: TrainingCallbacks,
    ) -> WarmStart:
        """The composer over all primitives, taught at first to do as the primitive that learned the
        clip, and as the recovery primitive on recovery motions and for characters that are far.

        owner: `(C,)`, the primitive of each clip of the library.
        """
        config, own = self.config, staged(practised(imitation, stage), stage)
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
        settings = self.clone_config(imitation)
        settings = replace(settings, rounds=min(1, settings.rounds), critic_steps=0)
        try:
            taught, _ = clone(
                cast(VecEnv, env),
                Owners(env, policy, owner, self.own_recovery),
                settings,
                imitation.ppo(),
                config.seed,
                tell.round,
                policy,
            )
        except UnstableError as problem:
            if tell.failed is not None:
                tell.failed(str(problem))
            return replace(before, policy=policy)
        finally:
            env.close()
        cost = {"samples": before.samples + taught.samples, "seconds": before.seconds + taught.seconds}
        return replace(before, policy=taught.policy, **cost)


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


#: The file of a run folder with the trajectories of its clips, as far as they were optimised.
PATHS = "paths.safetensors"


def find_paths(
    imitation: Imitation, folder: Path, threads: int, tell: TrainingCallbacks
) -> Trajectories:
    """A trajectory for every clip; goes on with what the folder holds of an unfinished optimisation."""
    config: StagedPerpetual = imitation.config
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
