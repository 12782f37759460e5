"""`poise train compliant`: a scene in which the character gives way, learned on top of a policy; and
`poise train compliant-imitation`: a controller that gives way, from nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from poise.cli.console import Answer, notes
from poise.cli.options import clips_in
from poise.cli.training import finished, on_the_cpu, refuse_held, working
from poise.cli.training import stopped as interrupted
from poise.cli.training import training as progress
from poise.jobs.keep import claimed

if TYPE_CHECKING:
    from poise.cli.options import Reading, Training
    from poise.papers.compliant.imitation_controller import CompliantImitation
    from poise.papers.compliant.scene_training import Compliant


def run(config: Compliant, out: Path, training: Training, earlier: Path | None, again: str) -> Answer:
    """Trains until the limit or Ctrl-C; a new run goes on from what was learned `earlier`."""
    from poise.jobs.open import open_run
    from poise.learn import LATEST, Until
    from poise.papers.compliant.scene_training import RUN_FILE, open_learned, train

    on_the_cpu("compliant", training)
    refuse_held(out, RUN_FILE, training)
    with working("opening the policy"):
        tracker = open_run(config.policy or None).tracker
        first = None if earlier is None else open_learned(earlier, tracker)
    until = Until(minutes=training.minutes, iterations=training.iterations)
    with claimed(out), progress(until) as show:
        result = train(config, tracker, out, until, show, training.threads, earlier=first)
    if result.interrupted:
        return interrupted(out, again)
    then = f"poise play compliant {config.scene} --learned {out} -o OUT shows it"
    told = finished(out, result.last, "limit", "samples", then)
    return Answer(told, {"run": out, "checkpoint": out / LATEST})


def controller(
    config: CompliantImitation,
    clips: Sequence[Path],
    reading: Reading,
    out: Path,
    training: Training,
    again: str,
) -> Answer:
    """Trains the imitation controller on files, and those in folders, until the limit or Ctrl-C."""
    from poise.jobs.run_file import RUN_FILE
    from poise.learn import LATEST, Until
    from poise.motion import ClipLibrary
    from poise.papers.compliant.controller_run import begin, train

    on_the_cpu("compliant-imitation", training)
    refuse_held(out, RUN_FILE, training)
    library = ClipLibrary(tuple(reading.read(f).replaced(name=n) for n, f in clips_in(clips, out)))
    until = Until(minutes=training.minutes, iterations=training.iterations)
    with claimed(out):
        with working("making the body"):
            made = begin(out, library, config)
        notes(made.report.sentences())
        with progress(until) as show:
            result = train(made, out, until, show, training.threads)
    if result.interrupted:
        return interrupted(out, again)
    then = f"poise play {out} shows it; poise play compliant hands --learned {out} -o OUT leads its hand"
    told = finished(out, result.last, "limit", "samples", then)
    return Answer(told, {"run": out, "checkpoint": out / LATEST})
