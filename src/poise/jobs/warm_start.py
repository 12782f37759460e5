"""How a run starts: a scripted expert is scored and cloned, and PPO goes on from the clone; or a policy
that was trained before goes on, for observations that tell it more, too.

The clone is saved as the run's first checkpoint, so that a killed run goes on from it bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv
from poise.errors import PoiseError
from poise.learn import (
    LATEST,
    CloneConfig,
    CloneStats,
    PolicyBundle,
    PPOConfig,
    Trainer,
    VecEnv,
    WarmStart,
    clone,
    load_checkpoint,
)
from poise.learn.checkpoint import PolicyMeta
from poise.learn.networks import RunningNorm
from poise.learn.parallel import ALONE, Comm, any_of, together
from poise.learn.policy import spread
from poise.plan import Expert, Plan, make_plan
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import pushed, stage_task
from poise.score import ScoreCard, run_episodes, score_rollouts, start_frames
from poise.sim import UnstableError

if TYPE_CHECKING:
    from poise.jobs.tracker import Tracker

#: Largest step size of a policy that is good already.
SMALL_STEP = 1e-4
#: Start frames of a first look; the final evaluation takes every one.
FIRST_STARTS = 64
#: The expert acts in no more worlds than these; more of them teach little more.
CLONE_WORLDS = 512
#: Control steps, and characters, by which what a policy did not observe before is measured.
MEASURED, MEASURED_IN = 64, 128


@dataclass(frozen=True)
class TrainingCallbacks:
    """Callbacks for what happens before PPO begins.

    Attributes:
        expert: the expert's own score.
        round: each round of cloning.
        cloned: the clone, once it is saved.
        failed: why the run begins without an expert.
        path: each iteration of a trajectory optimisation, as `papers.perpetual.trajopt` states it, and
            how many there are.
    """

    expert: Callable[[ScoreCard], None] | None = None
    round: Callable[[CloneStats], None] | None = None
    cloned: Callable[[PolicyBundle, WarmStart], None] | None = None
    failed: Callable[[str], None] | None = None
    path: Callable[[Any, int], None] | None = None


def start_training(
    imitation: Imitation,
    folder: Path,
    threads: int = 0,
    tell: TrainingCallbacks | None = None,
    comm: Comm = ALONE,
    device: str = "cpu",
) -> Trainer:
    """The run's trainer: fresh, from a cloned expert, or set up as the checkpoint in `folder` was.

    Of several processes the first clones, and the others take over what it learned. The expert acts on
    the CPU, whatever the `device` that PPO then uses.
    """
    tell = tell or TrainingCallbacks()

    def make(start: WarmStart | None, warm: bool) -> Trainer:
        ppo = finetuning(imitation.ppo()) if warm else None
        how: dict[str, Any] = {"start": "expert"} if warm else {}
        with together(comm):
            return imitation.trainer(threads, folder / "dumps", comm, start, ppo, device, **how)

    if (folder / LATEST).exists():
        warm = (
            load_checkpoint(folder / LATEST, PolicyMeta)[1].get("metadata", {}).get("start") == "expert"
        )
        return make(None, warm)
    if not imitation.config.expert:
        return make(None, False)
    start = None
    with together(comm):
        if comm.rank == 0:
            try:
                start = clone_expert(imitation, threads, folder / "dumps", tell)
            except UnstableError as problem:
                # A motion that throws the expert off may still be learned from nothing.
                if tell.failed is not None:
                    tell.failed(str(problem))
    if not any_of(comm, start is not None):
        return make(None, False)
    trainer = make(start, True)
    trainer.share_start()
    trainer.save(folder / LATEST)
    if tell.cloned is not None and start is not None:
        tell.cloned(trainer.policy(), start)
    return trainer


def clone_expert(
    imitation: Imitation,
    threads: int = 0,
    dumps: Path | None = None,
    tell: TrainingCallbacks | None = None,
    config: CloneConfig | None = None,
    start: PolicyBundle | None = None,
    acts: Callable[[ImitationEnv], Acts] | None = None,
) -> WarmStart:
    """Scores the expert and clones it into a policy of the recipe's networks and observation.

    Args:
        start: the policy that is taught, see `learn.clone`; a new perceptron by default.
        acts: makes a teacher in place of the expert, which needs no help.
    """
    tell, plan = tell or TrainingCallbacks(), None if acts else make_plan(imitation.reference)
    if tell.expert is not None and plan is not None:
        tell.expert(score_expert(imitation, plan))
    worlds = min(imitation.config.num_envs, CLONE_WORLDS)
    env = imitation.env(worlds, threads=threads, dumps=dumps)
    # The expert plans with the whole limit, which no success takes away while it is watched.
    env.help.schedule = None
    try:
        return clone(
            cast(VecEnv, env),
            acts(env) if acts else Expert(env, plan=plan),
            config,
            imitation.ppo(),
            imitation.config.seed,
            tell.round,
            start,
        )[0]
    finally:
        env.close()


def widened(tracker: Tracker, imitation: Imitation, steps: int = MEASURED) -> WarmStart:
    """A trained policy and its critic as what a run may start from that observes more.

    What it knows already goes to its places by the names of the observation's terms. What is new has
    weights of 0, so that the policy acts as before, and a mean and deviation as measured.

    Args:
        tracker: the policy, on the same body.
        imitation: what it is to learn, see `recipes.perpetual.build`.
        steps: control steps of `MEASURED_IN` characters by which new inputs are measured; 0 takes a mean
            of 0 and a deviation of 1.

    Raises:
        PoiseError: it observes what the new task does not tell.
    """
    known = replace(imitation, task=stage_task(tracker.config, imitation.humanoid, None)).bare()
    told, asked = _observed(known), _observed(imitation.bare())
    missing = [n for n, columns in told.items() if len(asked.get(n, ())) != len(columns)]
    if missing:
        name = missing[0]
        there = f", but {len(asked[name])} of them" if name in asked else ""
        raise PoiseError(
            f"the policy observes '{name}' of {len(told[name])} numbers, and the task does not{there}",
            hint="Take the policy's own settings of what is observed; more may be added to them",
            code="policy-unfit",
        )
    columns, wide = torch.cat([asked[n] for n in told]), sum(map(len, asked.values()))
    if len(columns) != tracker.policy.num_obs:
        what = f"it observes {tracker.policy.num_obs} numbers, and on this body they are {len(columns)}"
        raise PoiseError(
            what, hint="A policy goes on with the body that it was trained on", code="policy-unfit"
        )
    policy, critic = tracker.policy.widened(wide, columns), None
    if tracker.value is not None:
        own = tracker.value.state()
        first = next(k for k in own if k.startswith("critic/") and k.endswith("weight"))
        critic = spread(own, {first: own[first].new_zeros(len(own[first]), wide)}, columns)
    if steps and wide > len(columns):
        _measure(policy, imitation, columns, steps)
    return WarmStart(policy, critic)


def _observed(imitation: Imitation) -> dict[str, Tensor]:
    """The columns of each of a task's observations, by name and in order."""
    env = imitation.env(1, threads=1)
    try:
        every = torch.arange(env.num_obs)
        return {term.name: every[env.columns[term.name]] for term in env.task.obs}
    finally:
        env.close()


def _measure(policy: PolicyBundle, imitation: Imitation, columns: Tensor, steps: int) -> None:
    """Sets mean and deviation of the inputs beside `columns` to those of what the policy meets."""
    # Inputs that tell of pushes are measured while characters are pushed.
    task = pushed(imitation.task, imitation.config, imitation.humanoid)
    env = replace(imitation, task=task).env(MEASURED_IN, threads=1, help_scale=0.0, guard=False)
    norm = RunningNorm(env.num_obs)
    try:
        obs = env.reset()
        for _ in range(steps):
            norm.observe(obs)
            action = policy.act(obs)
            obs = env.step(torch.nn.functional.pad(action, (0, env.num_actions - action.shape[1]))).obs
    finally:
        env.close()
    norm.freeze()
    fresh = torch.ones(env.num_obs, dtype=torch.bool)
    fresh[columns] = False
    policy.norm.shift[fresh], policy.norm.std[fresh] = norm.shift[fresh], norm.std[fresh]
    policy.norm.mean[fresh] = norm.mean[fresh]
    policy.norm.m2[fresh] = norm.m2[fresh] / norm.count * policy.norm.count


def score_expert(imitation: Imitation, plan: Plan | None = None) -> ScoreCard:
    """The expert's own score card over `FIRST_STARTS` start frames."""
    clip, frame = some_starts(imitation)
    limit = imitation.task.residual.limit_n if imitation.task.residual else 0.0
    env = imitation.env(len(clip), auto_reset=False)
    rollouts, _ = run_episodes(lambda _: env, Expert(env, plan=plan), clip, frame, limit)
    return score_rollouts(rollouts, method="expert", seed=imitation.config.seed)


def some_starts(imitation: Imitation, most: int = FIRST_STARTS) -> tuple[Tensor, Tensor]:
    """(clip, frame) of at most `most` start frames, evenly spread, frame 0 of the first clip first."""
    clip, frame = start_frames(imitation.reference)
    picks = torch.linspace(0, len(clip) - 1, min(most, len(clip))).long()
    return clip[picks], frame[picks]


def critic_first(ppo: PPOConfig) -> PPOConfig:
    """The same settings for a policy that acts already: the critic learns alone at first."""
    return replace(ppo, critic_warmup=max(ppo.critic_warmup, 2))


def finetuning(ppo: PPOConfig) -> PPOConfig:
    """The same settings for a policy that is good already: small steps, the critic first."""
    return critic_first(replace(ppo, policy_lr=min(ppo.policy_lr, SMALL_STEP)))
