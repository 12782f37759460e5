"""From clips to results: a run folder that can be resumed, evaluated, played and delivered.

run/
    run.safetensors         the clips and the recipe's settings, all a run needs to be rebuilt
    checkpoint.safetensors  the trainer's whole state (learn.run)
    progress.csv            the learning curve (learn.run)
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from poise.env.help import scale_in
from poise.errors import PoiseError
from poise.eval import (
    Recording,
    RolloutSet,
    ScoreCard,
    run_episodes,
    run_in_batches,
    score_rollouts,
    start_frames,
)
from poise.jobs.warm_start import TrainingCallbacks, some_starts, start_training
from poise.learn import (
    LATEST,
    IterationStats,
    Policy,
    PolicyBundle,
    RunResult,
    Until,
    load_checkpoint,
    load_policy,
    run,
    save_checkpoint,
)
from poise.learn.parallel import ALONE, Comm
from poise.motion import ClipLibrary
from poise.motion.pack import pack_clips, unpack_clips
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import ResidualForce, build, config_of, most_help
from poise.settings import to_data

#: The file that says what a run is.
RUN_FILE = "run.safetensors"
#: The policy of a run that comes to an end by itself; it needs no help.
FINAL = "policy.safetensors"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What a policy did: the score card, the padded rollouts, one whole episode per clip."""

    card: ScoreCard
    rollouts: RolloutSet
    recordings: list[Recording]


def begin(folder: Path, library: ClipLibrary, config: ResidualForce, device: str = "cpu") -> Imitation:
    """Builds the task and writes the run file; a folder that holds another run is refused, and so are
    more characters than fit into the memory of the `device` that will train it."""
    imitation = build(library, config)
    imitation.check_memory(config.num_envs, device)
    path = folder / RUN_FILE
    tensors, notes = pack_clips(library.clips)
    meta = {"kind": "run", "recipe": "residual-force", "config": to_data(config), "clips": notes}
    meta["character"] = imitation.humanoid.identity
    if path.exists():
        _, found = load_checkpoint(path)
        if json.dumps(found.get("config")) != json.dumps(meta["config"]):
            raise PoiseError(
                "the folder holds a run with other settings",
                folder,
                "Resume it as it is or choose another",
            )
        if found.get("character") != meta["character"] or found.get("clips") != json.loads(
            json.dumps(notes)
        ):
            names = ", ".join(c["name"] for c in found["clips"])
            raise PoiseError(
                f"the folder holds a run of other clips ({names})",
                folder,
                "Choose another folder",
            )
        return imitation
    folder.mkdir(parents=True, exist_ok=True)
    save_checkpoint(path, tensors, meta)
    return imitation


def reopen(folder: Path) -> Imitation:
    """The task of an existing run, rebuilt from its folder alone."""
    path = folder / RUN_FILE
    if not path.exists():
        raise PoiseError(
            f"is no run folder: there is no {RUN_FILE} in it",
            folder,
            "Give the 'run' folder of a result",
        )
    tensors, meta = load_checkpoint(path)
    if meta.get("recipe") == "perpetual":
        from poise.jobs.perpetual import run as perpetual_run

        return perpetual_run.reopen(folder)
    config = config_of(meta["config"], path)
    return build(ClipLibrary(tuple(unpack_clips(tensors, meta["clips"]))), config)


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
    trainer = start_training(imitation, folder, threads, beginning, comm, device)
    try:
        return run(trainer, until, folder, on_iteration=on_iteration, tensorboard=tensorboard)
    finally:
        trainer.env.close()


def trained_policy(folder: Path, imitation: Imitation) -> tuple[PolicyBundle, dict[str, Any]]:
    """The run's latest policy, or that of a finished run, and its checkpoint's metadata."""
    path = folder / FINAL if (folder / FINAL).exists() else folder / LATEST
    if not path.exists():
        raise PoiseError("nothing has been trained in it yet", folder, "Train it with --resume first")
    policy = load_policy(path, character=imitation.humanoid.identity)
    if path.name == FINAL:
        return policy, policy.meta | policy.meta["metadata"] | {"help_limit": 0.0}
    left = scale_in(load_checkpoint(path)[0]) * most_help(imitation.config)
    return policy, {**policy.meta, "help_limit": left}


def help_left(
    imitation: Imitation, meta: Mapping[str, Any], asked: float | None = None
) -> tuple[float, float]:
    """The limit of the help in N and N m, and its share of the task's own limit.

    asked: N; by default what training has left of it (`meta["help_limit"]`).
    """
    most = 0.0 if imitation.config.method == "deepmimic" else most_help(imitation.config)
    limit = min(most, float(meta.get("help_limit", most))) if asked is None else asked
    if not 0 <= limit <= most:
        raise PoiseError(
            f"the policy was trained with help of at most {most:g} N, so it cannot have {limit:g} N",
            hint=f"Give a limit from 0 to {most:g}",
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
) -> Evaluation:
    """Start frames simulated to the end with the deterministic policy, and the score card.

    Args:
        help_limit: N and N m; by default what training has left of it (`meta["help_limit"]`).
        most: no more than so many start frames, evenly spread; None takes all.
        device: "cpu" or "cuda".
    """
    if isinstance(policy, PolicyBundle):
        policy = policy.copy().to(device)
    limit, scale = help_left(imitation, meta, help_limit)
    clip, start = start_frames(imitation.reference) if most is None else some_starts(imitation, most)
    rollouts, recordings = run_episodes(
        lambda n: imitation.env(n, auto_reset=False, help_scale=scale, device=device),
        policy,
        clip,
        start,
        limit,
        limit,
    )
    card = _score(rollouts, imitation, meta, rule)
    return Evaluation(card, rollouts, recordings)


def score(
    imitation: Imitation,
    policy: Policy,
    meta: Mapping[str, Any],
    rule: str = "phc",
    help_limit: float | None = None,
    device: str = "cpu",
) -> ScoreCard:
    """The score card of `evaluate`, without all frames of a large library in memory at once."""
    if isinstance(policy, PolicyBundle):
        policy = policy.copy().to(device)
    limit, scale = help_left(imitation, meta, help_limit)
    clip, start = start_frames(imitation.reference)
    parts = run_in_batches(
        lambda n: imitation.env(n, auto_reset=False, help_scale=scale, device=device),
        policy, imitation.reference, clip, start, limit, limit,
    )  # fmt: skip
    return _score(parts, imitation, meta, rule)


def _score(
    rollouts: RolloutSet | Iterable[RolloutSet], imitation: Imitation, meta: Mapping[str, Any], rule: str
) -> ScoreCard:
    return score_rollouts(
        rollouts,
        rule=rule,
        method=imitation.config.method,
        seconds=float(meta.get("seconds", 0.0)),
        samples=int(meta.get("samples", 0)),
        seed=imitation.config.seed,
    )


def learning_curve(folder: Path) -> dict[str, np.ndarray]:
    """Columns of the run's CSV by name; empty where nothing was trained."""
    path = next(iter(sorted(folder.glob("*.csv"))), None)
    if path is None:
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = rows[0].keys() if rows else ()
    return {name: np.array([float(r[name] or "nan") for r in rows]) for name in names}
