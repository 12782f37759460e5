"""Runs a trainer until a limit, with checkpoints, logs and a polite Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from poise.errors import PoiseError
from poise.learn.checkpoint import BEST, LAST_GOOD, LATEST, remove_partial
from poise.learn.guard import TrainingError
from poise.learn.log import Log
from poise.learn.parallel import any_of, together
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
    score: Callable[[IterationStats], float] | None = None,
    resume: bool = True,
    tensorboard: bool = True,
) -> RunResult:
    """Iterates until a limit; a killed run goes on from the last checkpoint bit for bit.

    Args:
        trainer: a fresh trainer; a checkpoint in `folder` is loaded into it.
        until: the limits.
        folder: holds `checkpoint.safetensors`, `best.safetensors` and the logs; None writes nothing.
        every: iterations between checkpoints, so at most `every` iterations are lost by a kill.
        on_iteration: called after each iteration and its checkpoint; returning False ends the run.
        score: rates an iteration; the policy with the highest score so far is kept as
            `best.safetensors` (a policy alone, for `load_policy`).
        resume: whether a checkpoint in `folder` may be continued; if not, finding one is an error.
        tensorboard: whether to write TensorBoard's files beside the CSV.

    Ctrl-C ends the run after the present iteration, with a checkpoint; a second one at once. After
    a `TrainingError` the policy of the last good iteration is in `last_good.safetensors`.

    Processes that train together (`poise.learn.parallel`) all call this with the same folder, which
    rank 0 writes; a wish to stop in one of them stops all after the same iteration.
    """
    if every < 1:
        raise PoiseError(f"the interval of checkpoints must be at least 1, got {every}")
    with together(trainer.comm):
        keeper = None if folder is None else _Keeper(trainer, Path(folder), resume, tensorboard)
    stats: IterationStats | None = None
    stop = until.reached(trainer)
    try:
        with interruptible() as interrupt:
            while not any_of(trainer.comm, stop or interrupt.is_set()):
                stats = trainer.iterate()
                stop = until.reached(trainer)
                if keeper is not None:
                    last = any_of(trainer.comm, stop or interrupt.is_set())
                    keeper.keep(stats, last or trainer.iteration % every == 0, score)
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
            keeper.save_policy(LAST_GOOD)
        raise
    finally:
        if keeper is not None and keeper.log is not None:
            keeper.log.close()
    return RunResult(stats, interrupted, None if keeper is None else keeper.path)


class _Keeper:
    """Writes checkpoints and logs in the order that makes a kill at any moment harmless."""

    def __init__(self, trainer: Trainer, folder: Path, resume: bool, tensorboard: bool):
        self.trainer, self.folder, self.path = trainer, folder, folder / LATEST
        self.best, writes = float("-inf"), trainer.comm.rank == 0
        if writes:
            folder.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            if not resume:
                raise PoiseError(
                    "the folder already holds a run", folder, "Resume it or choose another folder"
                )
            saved = trainer.load(self.path)["metadata"]
            if "best_score" in saved:
                self.best = trainer.metadata["best_score"] = saved["best_score"]
        if writes:
            remove_partial(folder)
        self.saved = trainer.iteration if self.path.exists() else -1
        self.log = Log(folder, trainer.iteration, tensorboard) if writes else None

    def keep(
        self, stats: IterationStats, save: bool, score: Callable[[IterationStats], float] | None
    ) -> None:
        # Rows first: a row after the last checkpoint is dropped on resume, a missing one is lost.
        if self.log is not None:
            self.log.write(stats.row())
        if score is not None and (value := score(stats)) > self.best:
            self.best = value
            self.trainer.metadata["best_score"] = value
            self.save_policy(BEST)
        if save:
            self.save()

    def save_policy(self, name: str) -> None:
        if self.trainer.comm.rank:
            return
        extra = {**self.trainer.metadata, "iteration": self.trainer.iteration}
        self.trainer.ppo.actor.save(self.folder / name, self.trainer.character, extra)

    def save(self) -> None:
        if self.log is not None:
            self.log.flush()
        self.trainer.save(self.path)
        self.saved = self.trainer.iteration


@contextmanager
def interruptible() -> Iterator[threading.Event]:
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
