"""`poise train inbetween`: an in-betweening network from a folder of clips."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from tyro.conf import arg

from poise.cli.console import Answer, say, tell
from poise.cli.library_options import Library
from poise.cli.recipe_options import derived
from poise.cli.training import clock, finished, refuse_held, showing
from poise.cli.training import stopped as interrupted
from poise.errors import PoiseError
from poise.jobs.keep import claimed
from poise.machine import cores

if TYPE_CHECKING:
    from poise.cli.options import Training
    from poise.jobs.inbetween.inbetween_settings import Inbetween
    from poise.learn.inbetween_model import BlockStats

if TYPE_CHECKING:
    _Derived: TypeAlias = Any
else:
    _Derived = derived("inbetween", "inbetween: ", "net", "contacts")


@dataclass(frozen=True)
class Network(_Derived):
    """What only the recipe inbetween knows."""

    dropout: Annotated[float | None, arg(metavar="SHARE", help_behavior_hint="(default: 0.0)")] = None
    """inbetween: share of the transformer's channels that a step leaves out; 0.15 suits less than an
    hour of motion."""


def run(library: Library, config: Inbetween, out: Path, training: Training, again: str) -> Answer:
    """Trains until the last step or Ctrl-C."""
    import torch

    from poise.jobs.inbetween.inbetween_training import RUN_FILE, begin, train

    folder = library.folder("inbetween")
    if library.backwards:
        raise PoiseError(
            "the recipe inbetween has no --backwards", hint="Leave it out", code="option-not-applicable"
        )
    refuse_held(out, RUN_FILE, training)
    torch.set_num_threads(training.threads or cores())
    dropout = config.between_training.dropout
    if not 0 <= dropout < 1:
        raise PoiseError(
            f"--dropout must be at least 0 and below 1, got {dropout:g}", code="out-of-range"
        )
    if dropout and config.net == "rtn":
        raise PoiseError(
            "the network rtn has no --dropout", hint="Leave it out", code="option-not-applicable"
        )
    reading = config.reading
    if library.library_fps or library.library_skeleton:
        # Its windows are seen in a mirror, not the clips.
        reading = replace(library.reading(), mirror=False)
    config = replace(
        config, name=folder.name, validation=library.hold_out or config.validation,
        final=library.never or config.final, mirror=library.mirror or config.mirror,
        onto=config.onto if library.onto is None else str(library.onto.resolve()), reading=reading,
    )  # fmt: skip
    minutes, steps = training.minutes, training.iterations
    with claimed(out):
        task, steps = begin(out, folder, config, minutes, steps, tell)
    used = len(task.data.first) - 1
    say(f"{used} clips, {task.data.frames:,} frames to learn from; {steps:,} steps")
    with showing("training") as show:
        _, stats, stopped = train(
            task, out, steps, None, lambda s: show(s.step / s.steps, f"{times(s)}  {figures(s)}")
        )
    if stopped:
        return interrupted(out, again)
    result = finished(out, stats, "last step", "windows")
    return Answer(result, {"run": out}, task.notes)


def times(stats: BlockStats) -> str:
    """How far it is."""
    return f"step {stats.step:,} of {stats.steps:,}, {clock(stats.left)} left"


def figures(stats: BlockStats) -> str:
    """What one block of steps says."""
    said = [f"{stats.samples_per_s:,.0f} windows/s", f"loss {stats.parts['loss']:.3f}"]
    said += [
        f"{k.split('/')[1]} {v:.3f}" for k, v in stats.parts.items() if k.startswith("validation/l2p")
    ]
    return "  ".join(said)
