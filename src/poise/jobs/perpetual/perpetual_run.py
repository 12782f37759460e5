"""A run of the perpetual controller in a folder: begun, trained, evaluated, opened, kept as a file.

run/
    run.safetensors         the clips and the settings, all that the run needs to be rebuilt
    checkpoint.safetensors  the stage in progress with everything that decides what comes next
    primitive-K.safetensors each primitive as it was when its stage ended; recovery.safetensors likewise
    policy.safetensors      the policy of the finished run
    log.csv, success.csv    the learning curve; every evaluation of every clip
    result.json             what the finished run came to, without help
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from poise.body import BodyConfig
from poise.env.recovery.get_up import RecoveryClips
from poise.errors import PoiseError
from poise.jobs.library.clips import LibraryConfig, Target
from poise.jobs.library.folder import library_of, split
from poise.jobs.perpetual.evaluation import FINAL_STAGE, evaluate_clips, try_recovery
from poise.jobs.perpetual.stage_trainer import StageTrainer
from poise.jobs.perpetual.stages import Progress, Stage, staged
from poise.jobs.run_file import FINAL, RUN_FILE, RunFile, body_facts, held_run, write_run
from poise.jobs.warm_start import SMALL_STEP, TrainingCallbacks
from poise.learn import LATEST, PolicyBundle, Until, WarmStart, load_checkpoint
from poise.learn.checkpoint import PolicyMeta, alone, prefixed, under, write_atomic
from poise.learn.run import interruptible
from poise.motion import ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import RECIPE, build, task
from poise.recipes.perpetual_settings import WIDE, Perpetual, config_of
from poise.score import ClipResults, RecoveryCard
from poise.settings import to_data
from poise.version import __version__

if TYPE_CHECKING:
    from poise.jobs.tracker import Tracker


RESULT = "result.json"


@dataclass(frozen=True, eq=False)
class PerpetualResult:
    """How a training ended.

    last: the last iteration, None where nothing was left to do. interrupted: by Ctrl-C; then there is no
    `results`, which are those of the finished policy on every clip, without help. solved: nothing
    failed any more before the time was over. primitives: how many were trained, beside that of
    recovery. recovery: trials of it with the finished policy, None where it never learned any.
    """

    last: Progress | None
    interrupted: bool
    solved: bool
    primitives: int
    results: ClipResults | None
    recovery: RecoveryCard | None = None


def finish(stages: StageTrainer) -> tuple[ClipResults, RecoveryCard | None]:
    """The policy as a file, and what it does with every clip, without help, and in trials of recovery if
    it learned that, as `result.json`."""
    policy, t, stage = stages.policy(), stages.trainer, stages.stage
    imitation, where = staged(stages.imitation, stage), (stages.threads, stages.device)
    facts = {
        "method": imitation.config.method,
        "seed": imitation.config.seed,
        "stage": stage.name,
        "recovers": stages.recovers,
        "primitives": stages.primitives,
        "solved": stages.finished,
        "iterations": stages.iteration,
    }
    cost = {"samples": t.samples, "seconds": round(t.seconds, 1)}
    results, card = evaluate_clips(imitation, policy, None, 0.0, *where), None
    if stages.recovers:
        card = try_recovery(imitation, policy, imitation.config.recovering.final_trials, *where)
    stages.history.add(stages.iteration, FINAL_STAGE, 0.0, results)
    policy.save(stages.folder / FINAL, t.character, facts | cost)
    names, owner = imitation.library.names, stages.stage_record.owner.tolist()
    rows = [
        {
            "clip": names[c],
            "succeeded": bool(results.succeeded[k]),
            "frames": int(results.frames[k]),
            "tracked": int(results.tracked[k]),
            "mpjpe_mm": round(float(results.mpjpe_mm[k]), 3),
            "mpjpe_global_mm": round(float(results.global_mm[k]), 3),
            "primitive": owner[c] + 1,
        }
        for k, c in enumerate(results.clip.tolist())
    ]
    said = (
        facts
        | cost
        | {
            "version": __version__,
            "help_n": 0.0,
            "succ": results.rate,
            "clips": len(rows),
            "mpjpe_global_mm": round(results.error_mm, 3),
            "recovery": {
                "policy": None if card is None else card.to_dict(),
                "primitive": stages.stage_record.recovery,
            },
            "hardest": [names[c] for c in results.hardest(20)],
            "per_clip": rows,
        }
    )
    write_atomic(stages.folder / RESULT, json.dumps(said, indent=2, allow_nan=False).encode())
    return results, card


#: Where a run file holds what its library knows of coming back.
WAYS = "ways"
#: What a policy that goes on keeps whatever is stated: its weights are bound to what it observes, does
#: and is, and `going_on` decides how it starts.
KEPT = frozenset((
    "goal", "shape", "shapes", "heading", "window", "filter", "action", "faithful", "style", "recovery",
    "clone", "single_hidden", "expert", "help_start", "help_share", "body", "sim", "ppo.policy_hidden",
    "ppo.value_hidden", "ppo.activation", "ppo.learn_std", "ppo.obs_clip",
))  # fmt: skip


def going_on(policy: Perpetual, wanted: Perpetual) -> Perpetual:
    """The settings of a run that goes on from a policy: the policy's own, and of those that are wanted
    the worlds, the seed, and whether and how recovery is learned. Observations are clipped no nearer
    than at `WIDE` deviations. Settings that are not in `KEPT` may be changed afterwards.

    Raises:
        PoiseError: the policy is made of primitives.
    """
    if policy.primitives:
        raise PoiseError(
            "the policy is made of primitives and a composer, which are frozen and cannot go on",
            hint="Go on from a single network, or resume its run",
            code="policy-of-primitives",
        )
    done = {"expert": False, "help_start": 0.0}
    asked = {name: getattr(wanted, name) for name in ("seed", "num_envs", "recovery", "noise")}
    quick = policy.recovering.quick or wanted.recovering.quick
    demonstrations = wanted.recovering.demonstrations
    asked["recovering"] = replace(policy.recovering, demonstrations=demonstrations, quick=quick)
    # The step size that the policy ended with is too small for learning something new.
    step = SMALL_STEP if wanted.recovery else min(policy.ppo.policy_lr, SMALL_STEP)
    ppo = replace(policy.ppo, obs_clip=max(policy.ppo.obs_clip, WIDE), policy_lr=step)
    return replace(policy, ppo=ppo, **done, **asked)


def clips_of(
    folder: Path,
    body: BodyConfig,
    hold_out: Sequence[str] = (),
    leave_out: Sequence[str] = (),
    tell: Callable[[str], None] = lambda _: None,
    onto: Path | Target | None = None,
    config: LibraryConfig | None = None,
) -> tuple[ClipLibrary, tuple[str, ...]]:
    """The clips of a folder on one skeleton, see `library_of`, and sentences on what became of them.

    Args:
        hold_out: clips and performers that are not learned from, see `split`.
        leave_out: regular expressions of clips that are not even read.
        onto: a motion file or an MJCF body, to give all clips its skeleton, or the body of a policy; by
            default the skeleton on which most of the library is.
        config: how files are read.
    """
    config = replace(config or LibraryConfig(), leave_out=tuple(leave_out))
    library, report = library_of(folder, onto, config=config, body=body, tell=tell)
    notes = tuple(report.sentences())
    if not hold_out:
        return library, notes
    parts = split(library, hold_out)
    return parts.train, (*notes, f"{len(parts.test)} clips are held out.")


def begin(
    folder: Path,
    library: ClipLibrary,
    config: Perpetual,
    source: str = "",
    device: str = "cpu",
    earlier: Tracker | None = None,
) -> Imitation:
    """Builds the task and writes the run file; a folder that holds another run is refused.

    Args:
        source: where the clips are from, by which `resume` knows them.
        earlier: the policy that the run goes on from; a single clip will do for that.

    Raises:
        PoiseError: a single clip, another run in the folder, a library on another skeleton than the
            policy's body, or not enough memory.
    """
    if len(library) < 2 and earlier is None:
        raise PoiseError(
            f"a library needs at least 2 clips, and there is only '{library.names[0]}'",
            hint="Use poise imitate for a single clip",
            code="library-too-small",
        )
    held = (folder / RUN_FILE).exists()
    if held:
        held_run(folder, RECIPE["name"], config, partial(config_of, kind=type(config)), library, source)
    table = None
    if earlier is not None:
        table = earlier.target.table
        if not library.clips[0].skeleton.same_bones(earlier.target.skeleton):
            raise PoiseError(
                "the clips are on another skeleton than the policy's body",
                hint="Bring them onto it: library_of(folder, tracker.target)",
                code="skeleton-differs",
            )
    # What a policy knows of coming back it keeps, whatever its new library holds of that.
    imitation = build(library, config, table, earlier.recovery_clips if earlier else None)
    imitation.check(config.num_envs, device)
    if not held:
        meta = {"recipe": RECIPE["name"], "config": to_data(config), "source": source}
        meta |= body_facts(imitation.humanoid, imitation.library.names)
        if earlier is not None:
            meta["earlier"] = {name: earlier.about[name] for name in ("samples", "seconds")}
            meta["table"] = earlier.target.table.to_dict()
        known = imitation.recovery_clips
        write_run(folder, library, meta, {} if known is None else prefixed(WAYS, known.state()))
    return imitation


def resume(folder: Path, config: Perpetual, source: str = "", device: str = "cpu") -> Imitation:
    """The task of the run in a folder, from that folder alone, if it has these settings.

    Raises:
        PoiseError: other settings, another source of clips, or another recipe.
    """
    read = partial(config_of, kind=type(config))
    imitation = _rebuilt(held_run(folder, RECIPE["name"], config, read, source=source), type(config))
    imitation.check(config.num_envs, device)
    return imitation


def reopen(file: RunFile) -> Imitation:
    """The task of an existing run as its latest policy knows it, rebuilt from its file alone.

    A policy that has not come to recovery yet must not see point goals; its `config` is without.
    """
    imitation = _rebuilt(file)
    config: Perpetual = imitation.config
    if not config.recovery or knows_recovery(file.path.parent):
        return imitation
    config = replace(config, recovery=False)
    return replace(imitation, config=config, task=task(config, imitation.humanoid), recovery_clips=None)


def _rebuilt(file: RunFile, kind: type[Perpetual] | None = None) -> Imitation:
    told = under(WAYS, file.tensors)
    known = RecoveryClips.of(told) if told else None
    config = config_of(file.meta["config"], file.path, kind)
    return build(file.library(), config, file.table(), known)


def knows_recovery(folder: Path) -> bool:
    """Whether the stage of a run's latest policy learned to recover; True where there is none yet."""
    path = folder / FINAL if (folder / FINAL).exists() else folder / LATEST
    if not path.exists():
        return True
    said = load_checkpoint(path, PolicyMeta)[1].get("metadata", {})
    try:
        if path.name == FINAL:
            return bool(said["recovers"])
        return Stage(**said["course"]["stage"]).recovers is not None
    except (KeyError, TypeError, ValueError):
        raise PoiseError(
            "it does not say what its stage learns", path, "The file is damaged", code="file-damaged"
        ) from None


@alone
def train(
    imitation: Imitation,
    folder: Path,
    until: Until,
    on_iteration: Callable[[Progress], bool | None] | None = None,
    threads: int = 0,
    tensorboard: bool = True,
    device: str = "cpu",
    beginning: TrainingCallbacks | None = None,
    save_s: float | None = None,
    trained: PolicyBundle | WarmStart | None = None,
) -> PerpetualResult:
    """Trains all stages, or goes on with them, until nothing fails or a limit is reached.

    Args:
        until: limits of all stages together, over all resumed runs.
        on_iteration: called after each; returning False ends the call as Ctrl-C does.
        device: "cpu" or "cuda"; no part of the run.
        save_s: seconds between checkpoints, beside those at evaluations; see `StageTrainer`.
        trained: a policy that a new run goes on from, with its critic if one is given, see
            `warm_start.widened`; a run in progress has its own.

    Ctrl-C ends it after the present iteration with a checkpoint, a second one at once.
    """
    stages = StageTrainer(
        imitation, folder, until, threads, device, tensorboard, beginning, save_s, trained
    )
    last, asked = None, False
    try:
        if not (stages.finished or stages.share >= 1):
            # What is in it is no longer the policy of a finished run.
            for name in (FINAL, RESULT):
                (folder / name).unlink(missing_ok=True)
        with interruptible() as interrupt:
            while not (stages.finished or stages.share >= 1 or interrupt.is_set() or asked):
                last = stages.iterate()
                try:
                    asked = on_iteration is not None and on_iteration(last) is False
                except KeyboardInterrupt:
                    interrupt.set()
            interrupted = asked or interrupt.is_set()
        if last is not None:
            stages.save()
        stopped = interrupted and not stages.finished and stages.share < 1
        results, card = (None, None) if stopped else finish(stages)
        done = (stages.finished, stages.primitives, results, card)
        return PerpetualResult(last, stopped, *done)
    finally:
        stages.close()
