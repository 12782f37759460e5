"""`poise train perpetual`: one policy for a whole library, stage after stage without a manual step."""

from __future__ import annotations

import contextlib
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from poise.cli import progress
from poise.cli.answer import Answer
from poise.cli.callbacks import beginning
from poise.cli.console import launched, notes, say, tell
from poise.cli.library_options import Library
from poise.cli.output import claimed
from poise.cli.perpetual_options import check_going_on
from poise.cli.perpetual_shown import report
from poise.cli.perpetual_shown import training as shown
from poise.cli.progress import clock
from poise.cli.training import stopped
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.cli.options import Training
    from poise.cli.train import Options
    from poise.jobs.tracker import Tracker
    from poise.recipes.imitation import Imitation
    from poise.recipes.perpetual import Perpetual


def run(o: Options, config: Perpetual, again: str) -> Answer:
    """Trains until nothing fails, a limit is reached, or Ctrl-C."""
    library, primitives, out, training, body = o.library, o.primitives, o.out, o.training, o.body
    library.folder("perpetual")
    if launched() and int(os.environ["WORLD_SIZE"]) > 1:
        hint = "Start it without torchrun; --threads and --device take all of one machine"
        raise PoiseError("the recipe perpetual trains in one process", hint=hint)
    from poise.jobs.perpetual.run import train
    from poise.jobs.runs import RUN_FILE
    from poise.learn import Until

    held = (out / RUN_FILE).exists()
    if held and not training.resume:
        raise PoiseError("already holds a run", out, "Go on with --resume, or choose another folder")
    tracker = None
    if primitives.going_on is not None:
        from poise.jobs.open import open_run
        from poise.jobs.perpetual.run import going_on

        check_going_on(primitives, body, library)
        tracker = open_run(primitives.going_on).tracker
        # Whether --max-primitives has a say is known by the policy alone.
        returns = tracker.recovery_clips is not None
        check_going_on(primitives, body, library, returns)
        if o.recipe_settings.num_envs is None:
            config = replace(config, num_envs=tracker.config.num_envs)
        config = going_on(tracker.config, config, returns)
    imitation = begin(library, out, config, training, held, tracker)
    until = Until(minutes=training.minutes, iterations=training.iterations)
    t, result = training, None
    with contextlib.suppress(KeyboardInterrupt), shown() as show:
        # A second Ctrl-C ends the present iteration too; what is in the last checkpoint stays.
        result = train(
            imitation, out, until, show, t.threads, device=t.device, beginning=beginning(),
            trained=tracker and tracker.policy,
        )  # fmt: skip
    if result is None or result.interrupted:
        where = "" if result is None or result.last is None else f" in {result.last.stage.name}"
        return stopped(out, again, where)
    return report(imitation, result, out)


def begin(
    library: Library,
    out: Path,
    config: Perpetual,
    training: Training,
    held: bool,
    tracker: Tracker | None,
) -> Imitation:
    """Reads the folder, tries the run folder, builds the task; nothing stays if that fails.

    held: the run folder holds a run already, which then is all that is read. tracker: the policy that it
    goes on from.
    """
    from poise.jobs.perpetual import run as perpetual_run

    folder = library.folder("perpetual")
    hold_out, never = ((p,) if p else () for p in (library.hold_out, library.never))
    source = ", without ".join((str(folder.resolve()), *hold_out, *never))
    source = ", ".join((source, *library.source()))
    earlier = None
    if tracker is not None:
        cost = tracker.about["samples"], tracker.about["seconds"]
        earlier = perpetual_run.Earlier(*cost, tracker.target)
    if held:
        with progress.working("opening the run"):
            return perpetual_run.resume(out, config, source, training.device)
    if training.resume:
        tell(f"There was no run in {out}; a new one starts.")
    onto = library.onto if tracker is None else tracker.target
    clips, said = perpetual_run.clips_of(
        folder, config.body, hold_out, never, tell, onto, library.reading()
    )
    say(f"{len(clips)} clips, {clock(clips.seconds)}")
    notes(said)
    with claimed(out), progress.working("making the body"):
        return perpetual_run.begin(out, clips, config, source, training.device, earlier)
