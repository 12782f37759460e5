"""`poise train endless`: a kinematic policy for `poise dream` from a folder of clips; and `poise train
dual-policy`: a control policy that follows one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from poise.cli.console import Answer, say, tell
from poise.cli.library_options import Library
from poise.cli.train_inbetween import times
from poise.cli.training import finished, on_the_cpu, refuse_held, showing, working
from poise.cli.training import stopped as interrupted
from poise.cli.training import training as progress
from poise.errors import PoiseError
from poise.jobs.keep import claimed
from poise.machine import cores

if TYPE_CHECKING:
    from poise.cli.options import Training
    from poise.jobs.endless.endless_training import Endless
    from poise.learn.inbetween_model import BlockStats
    from poise.papers.residual_force.dual_policy import DualPolicy


def run(
    library: Library, config: Endless, out: Path, training: Training, policy: Path | None, again: str
) -> Answer:
    """Trains until the last step or Ctrl-C.

    policy: the control policy; clips are brought onto its body; by default that of Poise.
    """
    import torch

    from poise.jobs.endless.endless_training import RUN_FILE, begin, train_generator
    from poise.jobs.endless.model import GENERATOR, read_labels
    from poise.jobs.open import open_run

    folder = library.folder("endless")
    for name in ("backwards", "onto"):
        if getattr(library, name):
            hint = "Leave it out; --from POLICY chooses the body" if name == "onto" else "Leave it out"
            raise PoiseError(
                f"the recipe endless has no --{name}", hint=hint, code="option-not-applicable"
            )
    labels = read_labels(folder)
    refuse_held(out, RUN_FILE, training)
    torch.set_num_threads(training.threads or cores())
    if training.iterations is not None:
        from poise.cli.recipe_options import configured

        config = configured(config, {"steps": training.iterations})
    counted = training.iterations is not None or training.preset == "paper"
    with claimed(out):
        motions, config = begin(
            out, folder, open_run(policy).tracker, config, None if counted else training.minutes,
            () if library.hold_out is None else (library.hold_out,),
            () if library.never is None else (library.never,), library.reading(), library.source(), tell,
        )  # fmt: skip
    frames = len(motions.frames.frames)
    say(f"{len(motions.clips)} clips, {frames:,} frames to learn from; {config.steps:,} steps")
    with showing("training") as show:
        _, stats, stopped = train_generator(
            motions, out, config, None, lambda s: show(s.step / s.steps, f"{times(s)}  {figures(s)}"),
            labels,
        )  # fmt: skip
    if stopped:
        return interrupted(out, again)
    then = f"poise dream --generator {out} -o OUT lets a character go about by it"
    result = finished(out, stats, "last step", "windows", then)
    return Answer(result, {"run": out, "generator": out / GENERATOR})


def control(
    config: DualPolicy,
    generator: Sequence[Path],
    out: Path,
    training: Training,
    policy: Path | None,
    again: str,
) -> Answer:
    """Trains the control policy of a kinematic policy until the limit or Ctrl-C.

    generator: its run or its file; none is that of the run that goes on, else that of Poise. policy:
    whose body it moves; by default that of Poise.
    """
    from poise.jobs.endless.model import load_generator
    from poise.jobs.open import open_run
    from poise.jobs.run_file import RUN_FILE
    from poise.jobs.runs import train
    from poise.learn import LATEST
    from poise.papers.residual_force.dual_run import begin

    if len(generator) > 1:
        raise PoiseError(
            f"one kinematic policy is followed at a time, got {len(generator)}", code="over-limit"
        )
    on_the_cpu("dual-policy", training)
    refuse_held(out, RUN_FILE, training)
    with working("opening the policies"):
        model = load_generator(generator[0]) if generator else None
        tracker = open_run(policy).tracker
    until = training.until()
    with claimed(out):
        made = begin(out, model, tracker, config)
        with progress(until) as show:
            result = train(made, out, until, show, training.threads)
    if result.interrupted:
        return interrupted(out, again)
    told = finished(out, result.last, "limit", "samples", f"poise play {out} shows it")
    return Answer(told, {"run": out, "checkpoint": out / LATEST})


def figures(stats: BlockStats) -> str:
    """What one block of steps says."""
    names = {"loss": "loss", "square": "error", "kl": "KL", "own_square": "error on its own past"}
    said = [f"{stats.samples_per_s:,.0f} windows/s"]
    said += [f"{text} {stats.parts[k]:.1f}" for k, text in names.items() if k in stats.parts]
    return "  ".join(said)
