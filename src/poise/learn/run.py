"""Runs a trainer until a limit, with checkpoints, logs and a polite Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from poise.errors import PoiseError
from poise.learn.checkpoint import LAST_GOOD, LATEST, remove_partial
from poise.learn.log import Log
from poise.learn.parallel import any_of, together
from poise.learn.rollout import TrainingError
from poise.learn.train import IterationStats, Trainer


@dataclass(frozen=True)
class Until:
    """When to stop: at the first limit reached, counted over all resumed runs."""

    minutes: float | None = None
    """Training time; evaluation and checkpoints do not count."""
    iterations: int | None = None
    samples: int | None = None

    def __post_init__(self) -> None:
        limits = [x for x in (self.minutes, self.iterations, self.samples) if x is not None]
        if not limits or min(limits) < 0:
            raise PoiseError(
                f"training needs a limit, got {self}", hint="Give minutes, iterations or samples"
            )

    def reached(self, trainer: Trainer) -> bool:
        """Whether the trainer has come to a limit."""
        return (
            (self.minutes is not None and trainer.seconds >= 60 * self.minutes)
            or (self.iterations is not None and trainer.iteration >= self.iterations)
            or (self.samples is not None and trainer.samples >= self.samples)
        )

    def share(self, iterations: int, samples: int, seconds: float) -> float:
        """How much of the nearest limit is used up, 0 to 1."""
        used = (
            (seconds / 60, self.minutes), (iterations, self.iterations), (samples, self.samples)
        )  # fmt: skip
        return min(1.0, max(a / b if b else 1.0 for a, b in used if b is not None))

    def done(self, iterations: int, samples: int, seconds: float) -> float:
        """How much of the training is done, 0 to 1, by which its stages and what anneals are planned.

        Where iterations or samples have a limit they alone are counted, so that no clock decides what
        is learned: the same command, killed and resumed or not, ends with the same policy. Time then
        only ends the training.
        """
        if self.minutes is None or (self.iterations, self.samples) == (None, None):
            return self.share(iterations, samples, seconds)
        if seconds >= 60 * self.minutes:
            return 1.0
        return replace(self, minutes=None).share(iterations, samples, seconds)


@dataclass(frozen=True)
class RunResult:
    """How a run ended."""

    last: IterationStats | None
    """The last iteration; None when the limit had been reached before."""
    interrupted: bool
    """Whether Ctrl-C ended it; the state is saved all the same."""
    checkpoint: Path | None


def run(
    trainer: Trainer,
    until: Until,
    folder: str | Path | None = None,
    every: int = 1,
    on_iteration: Callable[[IterationStats], bool | None] | None = None,
    tensorboard: bool = True,
    cooling: float = 0.0,
) -> RunResult:
    """Iterates until a limit; a killed run goes on from the last checkpoint bit for bit.

    Args:
        trainer: a fresh trainer; a checkpoint in `folder` is loaded into it.
        until: the limits.
        folder: holds `checkpoint.safetensors` and the logs; None writes nothing.
        every: iterations between checkpoints, so at most `every` iterations are lost by a kill.
        on_iteration: called after each iteration and its checkpoint; returning False ends the run.
        tensorboard: whether to write TensorBoard's files beside the CSV.
        cooling: share of the training, at its end, in which the policy makes ever smaller steps, see
            `PPO.cool`; 0 for none.

    Ctrl-C ends the run after the present iteration, with a checkpoint; a second one at once. After
    a `TrainingError` the policy of the last good iteration is in `last_good.safetensors`.

    Processes that train together (`poise.learn.parallel`) all call this with the same folder, which
    rank 0 writes; a wish to stop in one of them stops all after the same iteration.
    """
    if every < 1:
        raise PoiseError(f"the interval of checkpoints must be at least 1, got {every}")
    with together(trainer.comm):
        keeper = None if folder is None else _Keeper(trainer, Path(folder), tensorboard)
    stats: IterationStats | None = None
    stop = until.reached(trainer)
    try:
        with interruptible() as interrupt:
            while not any_of(trainer.comm, stop or interrupt.is_set()):
                if cooling:
                    done = until.done(trainer.iteration, trainer.samples, trainer.seconds)
                    trainer.ppo.cool(1.0 - done, cooling)
                stats = trainer.iterate()
                stop = until.reached(trainer)
                if keeper is not None:
                    last = any_of(trainer.comm, stop or interrupt.is_set())
                    keeper.keep(stats, last or trainer.iteration % every == 0)
                try:
                    if on_iteration is not None and on_iteration(stats) is False:
                        stop = True
                except KeyboardInterrupt:
                    interrupt.set()
            interrupted = any_of(trainer.comm, interrupt.is_set())
            if keeper is not None and keeper.saved != trainer.iteration:
                keeper.save()
    except TrainingError:
        if keeper is not None:
            keeper.save_last_good()
        raise
    finally:
        if keeper is not None and keeper.log is not None:
            keeper.log.close()
    return RunResult(stats, interrupted, None if keeper is None else keeper.path)


class _Keeper:
    """Writes checkpoints and logs in the order that makes a kill at any moment harmless."""

    def __init__(self, trainer: Trainer, folder: Path, tensorboard: bool):
        self.trainer, self.folder, self.path, self.saved = trainer, folder, folder / LATEST, -1
        writes = trainer.comm.rank == 0
        if writes:
            folder.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            trainer.load(self.path)
            self.saved = trainer.iteration
        if writes:
            remove_partial(folder)
        self.log = Log(folder, trainer.iteration, tensorboard) if writes else None

    def keep(self, stats: IterationStats, save: bool) -> None:
        # Rows first: a row after the last checkpoint is dropped on resume, a missing one is lost.
        if self.log is not None:
            self.log.write(stats.row())
        if save:
            self.save()

    def save_last_good(self) -> None:
        if self.trainer.comm.rank == 0:
            extra = {**self.trainer.metadata, "iteration": self.trainer.iteration}
            self.trainer.ppo.actor.save(self.folder / LAST_GOOD, self.trainer.character, extra)

    def save(self) -> None:
        if self.log is not None:
            self.log.flush()
        self.trainer.save(self.path)
        self.saved = self.trainer.iteration


@contextmanager
def interruptible() -> Generator[threading.Event]:
    """An event that the first Ctrl-C sets; the second raises `KeyboardInterrupt`.

    Only the main thread may catch signals; elsewhere the event is never set.
    """
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return

    def note(signum: int, frame: object) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    before = signal.signal(signal.SIGINT, note)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)
