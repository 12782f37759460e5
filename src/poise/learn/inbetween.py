"""Trains a network of kinematic motion: blocks of steps, checkpoints that go on bit for bit, a log."""

from __future__ import annotations

import copy
import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.learn.checkpoint import LATEST, load_checkpoint, remove_partial, save_checkpoint
from poise.learn.lock import alone
from poise.learn.log import Log
from poise.learn.rollout import TrainingError
from poise.learn.run import interruptible
from poise.learn.state import (
    State,
    load_module,
    load_optimizer_state,
    make_generator,
    optimizer_state,
    prefixed,
    set_generator,
    take,
    under,
)

#: Times that saving takes, which pass until the next checkpoint at least.
_SAVING = 20.0


class Objective(Protocol):
    """How a network learns from windows; the trainer only repeats it and keeps its state."""

    optimizers: dict[str, torch.optim.Optimizer]

    def modules(self) -> Mapping[str, nn.Module]:
        """Everything with weights, by name; "net" is the network itself."""
        ...

    def step(self, sampler: Any, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        """One update of step number `step`, and its figures, among them "loss"."""
        ...


@dataclass(frozen=True)
class BlockStats:
    """What one block of steps did; all but the times are the same for the same seed."""

    step: int
    """Steps so far."""
    steps: int
    """Steps of the whole training."""
    samples: int
    """Windows learned from so far."""
    parts: Mapping[str, float]
    """Means of the figures over the block."""
    seconds: float
    """Training time over all resumed runs."""
    samples_per_s: float

    @property
    def left(self) -> float:
        """Seconds to the end, as fast as so far."""
        return self.seconds * (self.steps - self.step) / max(1, self.step)


class InbetweenTrainer:
    """Repeats an objective's step; the averaged weights (EMA) are what is used afterwards.

    Args:
        objective: made for `steps` steps.
        sampler: what the objective draws its windows from.
        seed: of the windows that are drawn.
        steps: of the whole training.
        block: steps between two reports.
        ema: how much of the averaged weights stays at each step; early steps count less.
        metadata: JSON data that every checkpoint carries.
    """

    def __init__(
        self,
        objective: Objective,
        sampler: Any,
        seed: int = 0,
        steps: int = 20_000,
        batch: int = 64,
        block: int = 50,
        ema: float = 0.999,
        metadata: Mapping[str, Any] | None = None,
    ):
        if min(steps, batch, block) < 1 or not 0 <= ema < 1:
            raise PoiseError(f"steps, batch and block must be at least 1 and ema in [0, 1), got {ema}")
        self.objective, self.sampler = objective, sampler
        self.steps, self.batch, self.block, self.ema = steps, batch, block, ema
        self.metadata, self.seed = dict(metadata or {}), seed
        self.generator = make_generator(seed, "in-between windows")
        self.averaged = copy.deepcopy(objective.modules()["net"]).requires_grad_(False)
        self.step = 0
        self.seconds: float = 0.0

    @property
    def done(self) -> bool:
        """Whether all steps are made."""
        return self.step >= self.steps

    def iterate(self) -> BlockStats:
        """One block of steps.

        Raises:
            TrainingError: the loss is not finite.
        """
        begun = time.perf_counter()
        sums: dict[str, Tensor] = {}
        counts: dict[str, int] = {}
        count = min(self.block, self.steps - self.step)
        for _ in range(count):
            for name, value in self.objective.step(self.sampler, self.step, self.generator).items():
                sums[name] = sums.get(name, torch.zeros(())) + value
                counts[name] = counts.get(name, 0) + 1
            self._average()
            self.step += 1
        parts = {k: float(v) / counts[k] for k, v in sums.items()}
        if not math.isfinite(parts.get("loss", 0.0)):
            raise TrainingError(f"the loss at step {self.step} is not finite", hint="Lower the lr")
        seconds = time.perf_counter() - begun
        self.seconds += seconds
        rate = count * self.batch / max(seconds, 1e-9)
        return BlockStats(self.step, self.steps, self.step * self.batch, parts, self.seconds, rate)

    @torch.no_grad()
    def _average(self) -> None:
        # The first steps would otherwise weigh as much as a thousand later ones.
        keep = min(self.ema, (1 + self.step) / (10 + self.step))
        own = self.objective.modules()["net"]
        torch._foreach_lerp_(list(self.averaged.parameters()), list(own.parameters()), 1 - keep)
        for a, b in zip(self.averaged.buffers(), own.buffers(), strict=True):
            a.copy_(b)

    def state(self) -> State:
        """Copies of everything that training goes on from."""
        out = prefixed("averaged", self.averaged.state_dict())
        for name, module in self.objective.modules().items():
            out |= prefixed(f"module/{name}", module.state_dict())
        for name, optimizer in self.objective.optimizers.items():
            out |= prefixed(f"optimizer/{name}", optimizer_state(optimizer))
        out["generator/windows"] = self.generator.get_state().clone()
        out["counters"] = torch.tensor([self.step, self.seconds], dtype=torch.float64)
        return out

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from what `state` returned, with networks of the same sizes."""
        load_module(self.averaged, state, "averaged")
        for name, module in self.objective.modules().items():
            load_module(module, state, f"module/{name}")
        for name, optimizer in self.objective.optimizers.items():
            load_optimizer_state(optimizer, under(f"optimizer/{name}", state))
        set_generator(self.generator, take(state, "generator/windows"))
        step, self.seconds = take(state, "counters").tolist()
        self.step = int(step)

    def save(self, path: Path) -> None:
        """Writes the whole state; `load` goes on from it."""
        meta = {"kind": "inbetween trainer", "seed": self.seed, "steps": self.steps, "step": self.step,
                "metadata": self.metadata}  # fmt: skip
        save_checkpoint(path, self.state(), meta)

    def load(self, path: Path) -> dict[str, Any]:
        """Goes on from a checkpoint and returns its metadata.

        Raises:
            PoiseError: it is of another kind, or was made with other settings or data.
        """
        tensors, meta = load_checkpoint(path)
        if meta.get("kind") != "inbetween trainer":
            raise PoiseError("the checkpoint is of another kind of training", path)
        same = (meta["steps"], meta["seed"]) == (self.steps, self.seed)
        if not same or meta["metadata"] != self.metadata:
            raise PoiseError(
                "the checkpoint was made with other settings or another training set", path,
                "Resume it as it is or choose another folder",
            )  # fmt: skip
        self.load_state(tensors)
        return meta


@alone
def train_inbetween(
    trainer: InbetweenTrainer,
    folder: Path,
    minutes: float | None = None,
    on_block: Callable[[BlockStats], bool | None] | None = None,
    validate: Callable[[nn.Module], Mapping[str, float]] | None = None,
    validate_every: int = 1000,
    save_every: float = 60.0,
    tensorboard: bool = True,
) -> tuple[BlockStats | None, bool]:
    """Trains to the last step, for `minutes` of this call, or until Ctrl-C; the state is saved.

    Args:
        folder: holds `checkpoint.safetensors` and the log; what is there is gone on with.
        validate: figures of the averaged network, logged every `validate_every` steps.
        save_every: seconds between checkpoints at most; every block is saved where that costs little.

    Returns:
        The last block (None where nothing was left to do) and whether it was interrupted.
    """
    path, begun, stats = folder / LATEST, time.monotonic(), None
    folder.mkdir(parents=True, exist_ok=True)
    if path.exists():
        trainer.load(path)
    remove_partial(folder)
    # A kill loses what was learned since; saving may take a twentieth of the time.
    log, saved, due = Log(folder, trainer.step, tensorboard), time.monotonic(), 0.0
    try:
        with interruptible() as interrupt:
            stop = trainer.done
            while not stop and not interrupt.is_set():
                before = trainer.step
                stats = trainer.iterate()
                late = minutes is not None and time.monotonic() - begun >= 60 * minutes
                stop = trainer.done or late
                row = {"iteration": stats.step, "samples": stats.samples, **stats.parts}
                crossed = before // validate_every != trainer.step // validate_every
                if validate is not None and (crossed or stop):
                    row |= {f"validation/{k}": v for k, v in validate(trainer.averaged).items()}
                    stats = dataclasses.replace(stats, parts={k: float(v) for k, v in row.items()})
                row |= {"time/seconds": stats.seconds, "time/samples_per_s": stats.samples_per_s}
                log.write(row)
                if stop or interrupt.is_set() or time.monotonic() - saved >= due:
                    start = time.monotonic()
                    log.flush()
                    trainer.save(path)
                    saved = time.monotonic()
                    due = min(save_every, _SAVING * (saved - start))
                if on_block is not None and on_block(stats) is False:
                    stop = True
            interrupted = interrupt.is_set()
            trainer.save(path)
    finally:
        log.close()
    return stats, interrupted
