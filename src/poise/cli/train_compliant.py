"""`poise train compliant`: a scene in which the character gives way, learned on top of a policy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from poise.cli.console import Answer
from poise.cli.training import finished, refuse_held, working
from poise.cli.training import stopped as interrupted
from poise.cli.training import training as progress
from poise.errors import PoiseError
from poise.jobs.keep import claimed

if TYPE_CHECKING:
    from poise.cli.options import Training
    from poise.papers.compliant.scene_training import Compliant


def run(config: Compliant, out: Path, training: Training, again: str) -> Answer:
    """Trains until the limit or Ctrl-C."""
    from poise.jobs.open import open_run
    from poise.learn import LATEST, Until
    from poise.papers.compliant.scene_training import RUN_FILE, train

    if training.device != "cpu":
        raise PoiseError(
            "the recipe compliant trains on the CPU",
            hint="Leave --device out",
            code="option-not-applicable",
        )
    refuse_held(out, RUN_FILE, training)
    with working("opening the policy"):
        tracker = open_run(config.policy or None).tracker
    until = Until(minutes=training.minutes, iterations=training.iterations)
    with claimed(out), progress(until) as show:
        result = train(config, tracker, out, until, show, training.threads)
    if result.interrupted:
        return interrupted(out, again)
    then = f"poise play compliant {config.scene} --learned {out} -o OUT shows it"
    told = finished(out, result.last, "limit", "samples", then)
    return Answer(told, {"run": out, "checkpoint": out / LATEST})
