"""Trains a kinematic policy on a folder of clips, in a run folder.

run/
    motions.safetensors     the library on the body, and the settings: all that training needs
    checkpoint.safetensors  the training as it stands
    generator.safetensors   the kinematic policy
    log.csv                 the learning curve
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.jobs.endless.model import (
    GENERATOR,
    GeneratorModel,
    Label,
    Motions,
    clips_of_seeds,
    kinds_of,
    names_of,
    spread,
)
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.files import same_library
from poise.jobs.perpetual.perpetual_run import clips_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.kinematics.forward import Kinematics
from poise.learn.checkpoint import load_checkpoint, save_checkpoint, take
from poise.learn.cvae import (
    CVAE,
    CosineCVAE,
    CVAEConfig,
    CVAEObjective,
    CVAETraining,
    PackedFrames,
    make_cvae,
)
from poise.learn.inbetween_model import BlockStats, InbetweenTrainer, train_inbetween
from poise.motion import ClipLibrary
from poise.settings import Checked, Share, from_data, to_data
from poise.synthesis.generator import ROOT, Codes, coordinates, features_of

#: Pasts that are kept, from which motions begin.
SEEDS = 256
#: Windows below which a library is too small.
LEAST_WINDOWS = 50
#: How long velocities are thought to last, s.
LASTS = 0.5


@dataclass(frozen=True)
class Endless(Checked):
    """Settings of a kinematic policy's training.

    Attributes:
        net: sizes and kind of the network, see `learn.cvae.CVAEConfig`.
        training: see `learn.cvae.CVAETraining`.
        steps: steps of the whole training.
        ema: how much of the averaged weights stays at each step.
        codes: windows of the library that are kept as codes, from which z is drawn; 0 draws z from
            N(0, I), as the paper does.
        balance: how evenly labels are drawn where a library has any: 0 draws all windows evenly, 1 all
            labels, and what is between draws each label by its windows to the power of 1 - balance.
        seed: seed of everything random.
    """

    net: CVAEConfig = field(default_factory=lambda: CVAEConfig(decoder="cosine", hidden=512, latent=64))
    training: CVAETraining = field(default_factory=CVAETraining)
    steps: int = 20_000
    ema: float = 0.999
    codes: int = 4096
    balance: Share = 0.0
    seed: int = 0

    @classmethod
    def paper(cls) -> Endless:
        """What the paper states: 1,000 epochs of 10,000 windows in minibatches of 256."""
        return cls(CVAEConfig(), CVAETraining.paper(), steps=40_000, ema=0.0, codes=0)


def motions_of(
    library: ClipLibrary, tracker: Tracker, config: CVAEConfig, tell: Callable[[str], None] = print
) -> Motions:
    """The clips on a policy's body.

    Raises:
        PoiseError: too few windows.
    """
    rate = tracker.config.sim.control_hz
    qpos = [torch.tensor(place(c, tracker).qpos) for c in library]
    window = config.past + config.future
    usable = sum(max(0, len(q) - window + 1) for q in qpos)
    if usable < LEAST_WINDOWS:
        longest = max((len(q) for q in qpos), default=0)
        raise PoiseError(
            f"the library has {usable} windows of {window} frames in a row at {rate:g} Hz, and at least "
            f"{LEAST_WINDOWS} are needed; its longest clip has {longest} frames",
            hint=f"Give more clips that last longer than {window / rate:.1f} s",
            code="library-too-small",
        )
    tell(f"{len(qpos)} clips, {usable:,} windows of {window} frames")
    parts = [features_of(q, rate).float() for q in qpos]
    first = torch.tensor(np.cumsum([0, *(len(q) for q in qpos)]))
    pasts = [q[i : i + config.past] for q in qpos for i in range(0, len(q) - config.past, config.past)]
    picks = spread(len(pasts), SEEDS)
    angles = torch.cat(qpos)[:, 7:]
    bounds = torch.stack((angles.amin(0), angles.amax(0)))
    frames = torch.cat(parts)
    return Motions(
        PackedFrames(frames, first), torch.stack([pasts[i] for i in picks.tolist()]), bounds,
        reach_of(frames, tracker.humanoid.table, rate), tuple(tracker.humanoid.hinges), rate,
        tuple(c.name for c in library),
    )  # fmt: skip


def reach_of(frames: Tensor, table: BodyTable, fps: float, samples: int = 48) -> Tensor:
    """How far one deviation of each number of `frames (F, 10 + n)` moves the bodies' origins, root mean
    square of some frames, m `(10 + n)`; of velocities, in half a second."""
    some = frames[torch.linspace(0, len(frames) - 1, samples).long()].double()
    kinematics, deviations = Kinematics(table), frames.double().std(0)
    last = torch.zeros(samples, frames.shape[1] - ROOT + 7).double()
    last[:, 3] = 1.0

    def places(numbers: Tensor) -> Tensor:
        return kinematics(coordinates(numbers[:, None], last, fps)[:, 0]).pos

    out = torch.empty(frames.shape[1])
    for k, deviation in enumerate(deviations):
        other = some.clone()
        other[:, k] += deviation * (LASTS * fps if k < 3 else 1.0)
        out[k] = (places(other) - places(some)).square().sum(-1).mean().sqrt().float()
    return out


def read_motions(
    folder: Path, tracker: Tracker, sizes: CVAEConfig, hold_out: Sequence[str] = (),
    tell: Callable[[str], None] = lambda _: None, **how: object,
) -> Motions:  # fmt: skip
    """A folder's clips on a policy's body; `how` as `perpetual_run.clips_of` takes it."""
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
    labels: Sequence[Label] = (),
) -> tuple[GeneratorModel, BlockStats | None, bool]:
    """Trains, or goes on training, in `folder`, and writes the model there, with `labels` of its clips.

    Returns:
        the model, the last block (None where nothing was left to do), and whether Ctrl-C ended the
        training early.

    Raises:
        PoiseError: the folder holds a training with other settings or of another library.
    """
    c = config or Endless()
    kinds = kinds_of(motions.clips, labels)
    motions = balanced(motions, kinds, c)
    trainer = InbetweenTrainer(
        learner_of(motions, c), motions.frames, c.seed, c.steps, c.training.batch, ema=c.ema,
        metadata={"config": to_data(c), "clips": list(motions.clips)},
    )  # fmt: skip
    stats, stopped = train_inbetween(trainer, folder, minutes, on_block, tensorboard=False)
    made = copy.deepcopy(trainer.averaged).eval()
    assert isinstance(made, CVAE | CosineCVAE)
    about = {
        "clips": list(motions.clips), "frames": len(motions.frames.frames), "steps": trainer.step,
        "of": c.steps, "seconds": round(trainer.seconds, 1), "seed": c.seed,
    }  # fmt: skip
    codes = codes_of(made, motions, c.codes, kinds) if c.codes else None
    seeds, clips = seeds_of(motions, made.config)
    model = GeneratorModel(
        made, seeds, motions.bounds, motions.hinges, motions.fps, about, codes,
        names_of(labels), kinds[clips] if labels else None,
    )  # fmt: skip
    model.save(folder / GENERATOR)
    return model, stats, stopped


def balanced(motions: Motions, kinds: Tensor, config: Endless) -> Motions:
    """The motions with windows drawn as `Endless.balance` says; `kinds (C,)` are the clips' labels, all
    without one count as one more label."""
    if not config.balance or not bool((kinds >= 0).any()):
        return motions
    frames, window = motions.frames, config.net.past + config.net.future
    windows = torch.bincount(frames.clip[frames.room >= window], minlength=len(kinds)).double()
    many = torch.zeros(int(kinds.max()) + 2).double().index_add(0, kinds + 1, windows)
    weights = many.clamp_min(1.0).pow(-config.balance)[kinds + 1]
    return replace(motions, frames=PackedFrames(frames.frames, frames.first, weights))


def learner_of(motions: Motions, config: Endless) -> CVAEObjective:
    """A fresh network, calibrated to the motions, with how it learns."""
    features = ROOT + len(motions.hinges)
    net = make_cvae(features, config.net, torch.Generator().manual_seed(config.seed))
    net.calibrate(motions.frames.frames)
    return CVAEObjective(net, config.training, config.steps, motions.weights)


def seeds_of(motions: Motions, sizes: CVAEConfig) -> tuple[Tensor, Tensor]:
    """Pasts `(S, p, 7 + n)` that motions begin from, as likely as windows are, and clips `(S,)`."""
    if motions.frames.weights is None:
        return motions.seeds, clips_of_seeds(motions, sizes.past)
    start = _starts(motions, sizes.past + sizes.future, len(motions.seeds))
    some = motions.frames.frames[start[:, None] + torch.arange(sizes.past)].double()
    last = torch.zeros(len(some), motions.seeds.shape[-1]).double()
    last[:, 3] = 1.0
    return coordinates(some, last, motions.fps), motions.frames.clip[start]


def _starts(motions: Motions, window: int, count: int) -> Tensor:
    """First frames of at most so many windows, spread as they are drawn."""
    usable = (motions.frames.room >= window).nonzero()[:, 0]
    if motions.frames.weights is None:
        return usable[torch.linspace(0, len(usable) - 1, min(count, len(usable))).long()]
    share = motions.frames.weights[motions.frames.clip[usable]].double().cumsum(0)
    at = (torch.arange(count) + 0.5).double() / count * share[-1]
    return usable[torch.searchsorted(share, at).clamp_max(len(usable) - 1).unique()]


@torch.no_grad()
def codes_of(net: CVAE | CosineCVAE, motions: Motions, count: int, kinds: Tensor | None = None) -> Codes:
    """Codes of windows of the library, spread as they are drawn; `kinds (C,)` are the clips' labels."""
    p, window = net.config.past, net.config.past + net.config.future
    frames, start = motions.frames.frames, _starts(motions, window, count)
    clip = motions.frames.clip[start]
    codes = Codes(torch.empty(0), torch.empty(0), torch.empty(0), motions.weights.sqrt())
    parts = list[tuple[Tensor, Tensor, Tensor]]()
    for some in start.split(512):
        x = net.scaled(frames[some[:, None] + torch.arange(window)])
        code = net.encode(x[:, :p], x[:, p:])
        parts.append((codes.key_of(x[:, :p]), code.mean, code.log_var))
    keys, mean, log_var = (torch.cat(x) for x in zip(*parts, strict=True))
    kinds = kinds[clip] if kinds is not None and bool((kinds >= 0).any()) else None
    return replace(codes, keys=keys, mean=mean, log_var=log_var, kinds=kinds)


#: What a run begins with.
RUN_FILE = "motions.safetensors"
#: Steps that are timed before a training begins.
TRIALS = 8


class _TrainingMeta(TypedDict):
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
        if not same_library(of, said, motions.clips) or to_data(held) != wanted:
            what = "the folder holds a run of another library or with other settings"
            raise PoiseError(
                what, folder, "Resume it as it is or choose another folder", code="run-differs"
            )
        return motions, held
    motions = read_motions(
        library, tracker, config.net, hold_out, tell, leave_out=leave_out, config=reading
    )
    if minutes is not None:
        config = from_data(Endless, to_data(config) | {"steps": steps_in(motions, config, minutes)}, run)
    meta: _TrainingMeta = {
        "kind": "endless run",
        "config": to_data(config),
        "library": said,
        "hinges": list(motions.hinges),
        "fps": motions.fps,
        "clips": list(motions.clips),
    }
    tensors = {
        "frames": motions.frames.frames,
        "first": motions.frames.first,
        "seeds": motions.seeds,
        "bounds": motions.bounds,
        "reach": motions.reach,
    }
    save_checkpoint(run, tensors, dict(meta))
    return motions, config


def opened(run: Path) -> tuple[Motions, Endless, list[str]]:
    """The motions of a run, its settings, and what its library was.

    Raises:
        PoiseError: the file is damaged or of another kind.
    """
    tensors, meta = load_checkpoint(run, _TrainingMeta)
    if meta["kind"] != "endless run":
        raise PoiseError("the file is no training of a kinematic policy", run, code="wrong-file-kind")
    frames, first, seeds, bounds, reach = (
        take(tensors, k) for k in ("frames", "first", "seeds", "bounds", "reach")
    )
    motions = Motions(
        PackedFrames(frames, first),
        seeds,
        bounds,
        reach,
        tuple(meta["hinges"]),
        float(meta["fps"]),
        tuple(meta["clips"]),
    )
    return motions, from_data(Endless, meta["config"], run), meta["library"]


def steps_in(motions: Motions, config: Endless, minutes: float) -> int:
    """How many steps this machine makes in `minutes`, measured on a network that is thrown away."""
    learner, generator = learner_of(motions, config), torch.Generator().manual_seed(0)
    learner.step(motions.frames, 0, generator)
    begun = time.perf_counter()
    for _ in range(TRIALS):
        learner.step(motions.frames, 0, generator)
    return max(20, int(60 * minutes / ((time.perf_counter() - begun) / TRIALS)))
