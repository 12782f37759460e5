"""A kinematic policy's training in a folder: begun from a library, and gone on with.

run/
    motions.safetensors     the library on the body, and the settings: all that training needs
    checkpoint.safetensors  the training as it stands
    generator.safetensors   the kinematic policy
    log.csv                 the learning curve
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypedDict

import torch

from poise.errors import PoiseError
from poise.jobs.endless.training import Endless, Motions, learner_of, read_motions
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.tracker import Tracker
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.learn.cvae import Frames
from poise.learn.state import take
from poise.settings import from_data, to_data

#: What a run begins with.
RUN_FILE = "motions.safetensors"
#: Steps that are timed before a training begins.
TRIALS = 8


class _Meta(TypedDict):
    kind: str
    config: dict[str, Any]
    library: list[str]
    hinges: list[str]
    fps: float
    clips: list[str]


def begin(
    folder: Path,
    library: Path,
    tracker: Tracker,
    config: Endless,
    minutes: float | None = None,
    hold_out: Sequence[str] = (),
    leave_out: Sequence[str] = (),
    reading: LibraryConfig | None = None,
    source: Sequence[str] = (),
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Motions, Endless]:
    """Reads the library once, then what is kept of it, and fixes the number of steps.

    Args:
        minutes: as many steps as fit into them here, in place of those of the settings.
        source: what else tells one library from another, in words.

    Returns:
        the motions, and the settings: those of the run that is in the folder, if there is one.

    Raises:
        PoiseError: the folder holds a run of another library or with other settings, or the library is
            too small.
    """
    run, said = folder / RUN_FILE, [str(library.resolve()), *hold_out, *leave_out, *source]
    if run.exists():
        motions, held, of = opened(run)
        wanted = to_data(config) | ({"steps": held.steps} if minutes is not None else {})
        if of != said or to_data(held) != wanted:
            what = "the folder holds a run of another library or with other settings"
            raise PoiseError(what, folder, "Resume it as it is or choose another folder")
        return motions, held
    motions = read_motions(
        library, tracker, config.net, hold_out, tell, leave_out=leave_out, config=reading
    )
    if minutes is not None:
        config = from_data(Endless, to_data(config) | {"steps": steps_in(motions, config, minutes)}, run)
    meta: _Meta = {
        "kind": "endless run", "config": to_data(config), "library": said,
        "hinges": list(motions.hinges), "fps": motions.fps, "clips": list(motions.clips),
    }  # fmt: skip
    tensors = {
        "frames": motions.frames.frames, "first": motions.frames.first, "seeds": motions.seeds,
        "bounds": motions.bounds, "reach": motions.reach,
    }  # fmt: skip
    save_checkpoint(run, tensors, dict(meta))
    return motions, config


def opened(run: Path) -> tuple[Motions, Endless, list[str]]:
    """The motions of a run, its settings, and what its library was.

    Raises:
        PoiseError: the file is damaged or of another kind.
    """
    tensors, meta = load_checkpoint(run, _Meta)
    if meta["kind"] != "endless run":
        raise PoiseError("the file is no training of a kinematic policy", run)
    frames, first, seeds, bounds, reach = (
        take(tensors, k) for k in ("frames", "first", "seeds", "bounds", "reach")
    )
    motions = Motions(
        Frames(frames, first), seeds, bounds, reach, tuple(meta["hinges"]), float(meta["fps"]),
        tuple(meta["clips"]),
    )  # fmt: skip
    return motions, from_data(Endless, meta["config"], run), meta["library"]


def steps_in(motions: Motions, config: Endless, minutes: float) -> int:
    """How many steps this machine makes in `minutes`, measured on a network that is thrown away."""
    learner, generator = learner_of(motions, config), torch.Generator().manual_seed(0)
    learner.step(motions.frames, 0, generator)
    begun = time.perf_counter()
    for _ in range(TRIALS):
        learner.step(motions.frames, 0, generator)
    return max(20, int(60 * minutes / ((time.perf_counter() - begun) / TRIALS)))
