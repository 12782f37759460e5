"""A run of the residual force recipe: begun, trained; and how a run of any recipe is evaluated."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env import Acts, ImitationEnv, RewardTerm
from poise.errors import PoiseError
from poise.jobs.deliver import Evaluation
from poise.jobs.run_file import (
    RUN_FILE,
    body_facts,
    held_run,
    policy_for,
    write_run,
)
from poise.jobs.warm_start import TrainingCallbacks, some_starts, start_training
from poise.learn import (
    IterationStats,
    Policy,
    PolicyBundle,
    RunResult,
    Until,
    run,
)
from poise.learn.checkpoint import only_writer
from poise.learn.parallel import ALONE, Comm, together
from poise.motion import ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import RECIPE, build
from poise.recipes.residual_force_settings import ResidualForce, config_of, most_help
from poise.score import (
    TRACKING,
    Nothing,
    RolloutSet,
    ScoreCard,
    Transitions,
    record_transitions,
    run_episodes,
    run_in_batches,
    score_rollouts,
    start_frames,
)
from poise.settings import to_data


def begin(
    folder: Path,
    library: ClipLibrary,
    config: ResidualForce,
    device: str = "cpu",
    rewards: Callable[[Humanoid], Sequence[RewardTerm]] | None = None,
) -> Imitation:
    """Builds the task and writes the run file; a folder that holds another run is refused, and so are
    more characters than fit into the memory of the `device` that will train it.

    rewards: further ones, made for the body. The run file has their names, and no more of them.
    """
    held = (folder / RUN_FILE).exists()
    file = held_run(folder, RECIPE["name"], config, config_of, library) if held else None
    imitation = build(library, config)
    imitation.check(config.num_envs, device)
    terms = tuple(rewards(imitation.humanoid)) if rewards else ()
    names = [term.name for term in terms]
    if file is None:
        meta = {"recipe": RECIPE["name"], "config": to_data(config), "rewards": names}
        write_run(folder, library, meta | body_facts(imitation.humanoid, imitation.library.names))
    elif file.meta.get("character") != imitation.humanoid.identity:
        raise PoiseError(
            "the folder holds a run of another body",
            folder,
            "Choose another folder",
            code="bodies-differ",
        )
    elif (known := file.meta.get("rewards", [])) != names:
        raise PoiseError(
            f"the run was begun with the rewards {known or 'of its recipe'} of a program, not {names}",
            folder,
            "Go on with `poise.imitate(..., rewards=...)` and the same ones",
            code="settings-differ",
        )
    return replace(imitation, task=replace(imitation.task, rewards=(*imitation.task.rewards, *terms)))


def train(
    imitation: Imitation,
    folder: Path,
    until: Until,
    on_iteration: Callable[[IterationStats], bool | None] | None = None,
    threads: int = 0,
    tensorboard: bool = True,
    comm: Comm = ALONE,
    beginning: TrainingCallbacks | None = None,
    device: str = "cpu",
) -> RunResult:
    """Trains, or goes on training, in `folder`; see `poise.learn.run` and `jobs.warm_start`.

    device: "cpu" or "cuda". It is no part of the run: a run may go on on another device.
    """
    with ExitStack() as held:
        with together(comm):
            if comm.rank == 0:
                held.enter_context(only_writer(folder))
        trainer = start_training(imitation, folder, threads, beginning, comm, device)
        held.callback(trainer.env.close)
        return run(trainer, until, folder, on_iteration=on_iteration, tensorboard=tensorboard)


def trained_policy(folder: Path, imitation: Imitation) -> tuple[PolicyBundle, dict[str, Any]]:
    """The run's latest policy, or that of a finished run, and its checkpoint's metadata."""
    return policy_for(folder, imitation.humanoid, most_help(imitation.config))


def help_left(
    imitation: Imitation, meta: Mapping[str, Any], asked: float | None = None
) -> tuple[float, float]:
    """The limit of the help in N and N m, and its share of the task's own limit.

    asked: N; by default what training has left of it (`meta["help_limit"]`).
    """
    most = 0.0 if imitation.task.residual is None else most_help(imitation.config)
    limit = min(most, float(meta.get("help_limit", most))) if asked is None else asked
    if not 0 <= limit <= most:
        raise PoiseError(
            f"the policy was trained with help of at most {most:g} N, so it cannot have {limit:g} N",
            hint=f"Give a limit from 0 to {most:g}",
            code="out-of-range",
        )
    return limit, limit / most if most else 0.0


def evaluate(
    imitation: Imitation,
    policy: Policy,
    meta: Mapping[str, Any],
    rule: str = "phc",
    help_limit: float | None = None,
    most: int | None = None,
    device: str = "cpu",
    starts: tuple[Tensor, Tensor] | None = None,
) -> Evaluation:
    """Start frames simulated to the end with the deterministic policy, and the score card.

    Args:
        help_limit: N and N m; by default what training has left of it (`meta["help_limit"]`).
        most: no more than so many start frames, evenly spread; None takes all.
        device: "cpu" or "cuda".
        starts: clips and start frames `(E,)`, in place of `most` of all.
    """
    make, limit = _worlds(imitation, meta, help_limit, device)
    if starts is None:
        starts = start_frames(imitation.reference) if most is None else some_starts(imitation, most)
    rollouts, recordings = run_episodes(make, _on(policy, device), *starts, limit)
    return Evaluation(scored(rollouts, imitation, meta, rule), rollouts, recordings)


def score(
    imitation: Imitation,
    policy: Policy,
    meta: Mapping[str, Any],
    rule: str = "phc",
    help_limit: float | None = None,
    device: str = "cpu",
    starts: int = 1,
) -> ScoreCard:
    """The score card of `evaluate`, without all frames of a large library in memory at once, beside that
    of doing nothing.

    Args:
        starts: from 2 on every episode is begun so many times, each perturbed
            (`score.episodes.perturb`), and the figures are means over these, beside their spread.

    Raises:
        PoiseError: less than one start.
    """
    if starts < 1:
        raise PoiseError(
            f"an evaluation needs at least 1 start, got {starts}",
            hint="Give 8, for example",
            code="out-of-range",
        )
    make, limit = _worlds(imitation, meta, help_limit, device)
    clip, frame = (x.repeat(starts) for x in start_frames(imitation.reference))
    trial = torch.arange(starts).repeat_interleave(len(clip) // starts) if starts > 1 else None

    def card(acts: Acts) -> ScoreCard:
        parts = run_in_batches(make, acts, imitation.reference, clip, frame, limit, trial=trial)
        return scored(parts, imitation, meta, rule)

    extra = imitation.task.residual.dims if imitation.task.residual else 0
    nothing = card(Nothing(len(imitation.humanoid.hinges) + extra))
    null = {key: getattr(nothing, key) for key in ("succ", *TRACKING)}
    return replace(card(_on(policy, device)), nothing=null)


def transitions(
    imitation: Imitation,
    policy: Policy,
    meta: Mapping[str, Any],
    help_limit: float | None = None,
    most: int | None = None,
    noise: float = 0.0,
    seed: int = 0,
    device: str = "cpu",
) -> Transitions:
    """Every step of the episodes of `evaluate`, see `record_transitions`."""
    make, _ = _worlds(imitation, meta, help_limit, device)
    if most is not None and most < 1:
        raise PoiseError(
            f"at least 1 start frame is needed, got {most}",
            hint="Give 32, for example",
            code="out-of-range",
        )
    starts = start_frames(imitation.reference) if most is None else some_starts(imitation, most)
    return record_transitions(make, _on(policy, device), *starts, noise, seed)


def _worlds(
    imitation: Imitation, meta: Mapping[str, Any], asked: float | None, device: str
) -> tuple[Callable[[int], ImitationEnv], float]:
    """How environments of N worlds are made, and the limit of their help, N and N m."""
    limit, scale = help_left(imitation, meta, asked)
    residual = imitation.task.residual
    if limit and residual is not None and not residual.capped:
        limit = math.inf
    return lambda n: imitation.env(n, auto_reset=False, help_scale=scale, device=device), limit


def _on(policy: Policy, device: str) -> Policy:
    return policy.copy().to(device) if isinstance(policy, PolicyBundle) else policy


def scored(
    rollouts: RolloutSet | Iterable[RolloutSet],
    imitation: Imitation,
    meta: Mapping[str, Any],
    rule: str,
    method: str = "",
) -> ScoreCard:
    """The score card of episodes of a task. meta: what the training of the policy took. method: what was
    tried, by default the recipe's."""
    return score_rollouts(
        rollouts,
        rule=rule,
        method=method or imitation.config.method,
        seconds=float(meta.get("seconds", 0.0)),
        samples=int(meta.get("samples", 0)),
        seed=imitation.config.seed,
    )
