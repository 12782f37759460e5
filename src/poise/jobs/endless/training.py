"""Trains a kinematic policy on a folder of clips, on the body of the policy that is to do its motion."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.jobs.endless.model import GENERATOR, GeneratorModel
from poise.jobs.perpetual.run import clips_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.learn.cvae import CVAEObjective, CVAETraining, Frames
from poise.learn.inbetween import BlockStats, InbetweenTrainer, train_inbetween
from poise.motion import ClipLibrary
from poise.nets.cvae import CVAE, CVAEConfig
from poise.settings import to_data, validate
from poise.synth.place_free import ROOT, features_of

#: Pasts that are kept, from which motions begin.
SEEDS = 256


@dataclass(frozen=True)
class Endless:
    """Settings of a kinematic policy's training.

    Attributes:
        net, training: see `nets.cvae` and `learn.cvae`.
        steps: of the whole training.
        ema: how much of the averaged weights stays at each step.
        seed: of the first weights and all draws.
    """

    net: CVAEConfig = field(default_factory=CVAEConfig)
    training: CVAETraining = field(default_factory=CVAETraining)
    steps: int = 8000
    ema: float = 0.999
    seed: int = 0

    def __post_init__(self) -> None:
        validate(self)

    @classmethod
    def paper(cls) -> Endless:
        """What the paper states: 1,000 epochs of 10,000 windows in minibatches of 256."""
        return cls(training=CVAETraining.paper(), steps=40_000, ema=0.0)


@dataclass(frozen=True, eq=False)
class Motions:
    """A library as a kinematic policy learns it.

    Attributes:
        frames: windows of frames that know no place, see `synth.place_free`.
        seeds: `(S, p, 7 + n)` pasts of the library, evenly spread.
        bounds: `(2, n)` rad, least and most of each hinge.
        hinges: names.
        fps: frames a second.
        clips: names.
    """

    frames: Frames
    seeds: Tensor
    bounds: Tensor
    hinges: tuple[str, ...]
    fps: float
    clips: tuple[str, ...]


def motions_of(
    library: ClipLibrary, tracker: Tracker, config: CVAEConfig, tell: Callable[[str], None] = print
) -> Motions:
    """The clips on a policy's body.

    Raises:
        PoiseError: too few frames in a row.
    """
    rate = tracker.config.sim.control_hz
    qpos = [torch.tensor(place(c, tracker).qpos) for c in library]
    window = config.past + config.future
    usable = sum(max(0, len(q) - window + 1) for q in qpos)
    if not usable:
        longest = max((len(q) for q in qpos), default=0)
        raise PoiseError(
            f"no clip has {window} frames in a row at {rate:g} Hz; the longest has {longest}",
            hint="Give longer clips, or a shorter past and future",
        )
    tell(f"{len(qpos)} clips, {usable:,} windows of {window} frames")
    parts = [features_of(q, rate).float() for q in qpos]
    first = torch.tensor(np.cumsum([0, *(len(q) for q in qpos)]))
    pasts = [q[i : i + config.past] for q in qpos for i in range(0, len(q) - config.past, config.past)]
    picks = np.linspace(0, len(pasts) - 1, min(SEEDS, len(pasts))).round().astype(int)
    angles = torch.cat(qpos)[:, 7:]
    bounds = torch.stack((angles.amin(0), angles.amax(0)))
    return Motions(
        Frames(torch.cat(parts), first), torch.stack([pasts[i] for i in picks]), bounds,
        tuple(tracker.humanoid.hinges), rate, tuple(c.name for c in library),
    )  # fmt: skip


def read_motions(
    folder: Path, tracker: Tracker, sizes: CVAEConfig, hold_out: Sequence[str] = (),
    tell: Callable[[str], None] = lambda _: None, **how: object,
) -> Motions:  # fmt: skip
    """A folder's clips on a policy's body; `how` as `perpetual.run.clips_of` takes it."""
    body = tracker.config.body
    library, notes = clips_of(folder, body, hold_out, tell=tell, onto=tracker.target, **how)  # type: ignore[arg-type]
    for note in notes:
        tell(note)
    return motions_of(library, tracker, sizes, tell)


def train_generator(
    motions: Motions,
    folder: Path,
    config: Endless | None = None,
    minutes: float | None = None,
    on_block: Callable[[BlockStats], bool | None] | None = None,
) -> tuple[GeneratorModel, bool]:
    """Trains, or goes on training, in `folder`, and writes the model there.

    Returns:
        the model, and whether Ctrl-C ended the training early.

    Raises:
        PoiseError: the folder holds a training with other settings or of another library.
    """
    c = config or Endless()
    features = ROOT + len(motions.hinges)
    net = CVAE(features, c.net, generator=torch.Generator().manual_seed(c.seed))
    net.calibrate(motions.frames.frames)
    learner = CVAEObjective(net, c.training, c.steps)
    trainer = InbetweenTrainer(
        learner, motions.frames, c.seed, c.steps, c.training.batch, ema=c.ema,
        metadata={"config": to_data(c), "clips": list(motions.clips)},
    )  # fmt: skip
    _, stopped = train_inbetween(trainer, folder, minutes, on_block, tensorboard=False)
    made = copy.deepcopy(trainer.averaged).eval()
    assert isinstance(made, CVAE)
    about = {
        "clips": list(motions.clips), "frames": len(motions.frames.frames), "steps": trainer.step,
        "of": c.steps, "seconds": round(trainer.seconds, 1), "seed": c.seed,
    }  # fmt: skip
    model = GeneratorModel(made, motions.seeds, motions.bounds, motions.hinges, motions.fps, about)
    model.save(folder / GENERATOR)
    return model, stopped
