"""Runs a trainer until a limit, with checkpoints, logs and a polite Ctrl-C."""

# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
from __future__ import annotations

import csv
import io
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

from poise.errors import PoiseError
from poise.learn.checkpoint import LAST_GOOD, LATEST, remove_partial, write_atomic
from poise.learn.parallel import any_of, together
from poise.learn.rollout import TrainingError
from poise.learn.trainer import IterationStats, Trainer
from poise.settings import Range, validate

CSV_NAME = "log.csv"
TENSORBOARD_NAME = "tensorboard"


class Log:
    """Appends one row of numbers per iteration to a CSV file and to TensorBoard.

    Args:
        folder: where `log.csv` and `tensorboard/` live.
        last: iterations after this one are dropped from existing files, so that a resumed run
            leaves the files of an uninterrupted one; 0 starts afresh.
        tensorboard: whether to write TensorBoard's events; its package is imported only then.
    """

    def __init__(self, folder: str | Path, last: int = 0, tensorboard: bool = True):
        self.path = Path(folder) / CSV_NAME
        self.columns: list[str] = []
        self._rewrite([row for row in self._read() if _iteration(row) <= last])
        self._file = self.path.open("a", newline="")
        self._events = _Events(Path(folder) / TENSORBOARD_NAME, last) if tensorboard else None

    def write(self, row: Mapping[str, float]) -> None:
        """Adds a row; it holds "iteration". New names become new columns at the end."""
        added = [name for name in row if name not in self.columns]
        if added:
            self._file.close()
            rows = self._read()
            self.columns += added
            self._rewrite(rows)
            self._file = self.path.open("a", newline="")
        csv.writer(self._file).writerow([_text(row[c]) if c in row else "" for c in self.columns])
        if self._events is not None:
            self._events.add(row)

    def flush(self) -> None:
        """Brings all rows to the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())
        if self._events is not None:
            self._events.writer.flush()

    def close(self) -> None:
        """Flushes and closes the files; calling it twice is allowed."""
        if not self._file.closed:
            self.flush()
            self._file.close()
            if self._events is not None:
                self._events.writer.close()

    def _read(self) -> list[dict[str, str]]:
        if not self.path.exists():
            return []
        with self.path.open(newline="") as file:
            lines = list(csv.reader(file))
        if not lines:
            return []
        self.columns = lines[0]
        # A process that was killed may have left half a line.
        return [dict(zip(lines[0], x, strict=True)) for x in lines[1:] if len(x) == len(lines[0])]

    def _rewrite(self, rows: list[dict[str, str]]) -> None:
        if not rows and not self.path.exists():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.touch()
            return
        text = io.StringIO(newline="")
        writer = csv.writer(text)
        if self.columns:
            writer.writerow(self.columns)
        writer.writerows([[row.get(c, "") for c in self.columns] for row in rows])
        write_atomic(self.path, text.getvalue().encode())


def _text(value: float) -> str:
    return str(value) if isinstance(value, int) else repr(float(value))


def _iteration(row: Mapping[str, str]) -> float:
    try:
        return float(row["iteration"])
    except (KeyError, ValueError):
        return float("inf")


class _Events:
    """TensorBoard scalars through the `tensorboard` package alone."""

    def __init__(self, folder: Path, last: int):
        # The import costs 0.2 s, and torch's own writer twice that, so only a run that logs pays.
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        events: Any = import_module("tensorboard.compat.proto.event_pb2")
        self.event = events.Event
        self.summary = import_module("tensorboard.compat.proto.summary_pb2").Summary
        folder.mkdir(parents=True, exist_ok=True)
        self.writer = EventFileWriter(str(folder))
        # A start mark tells TensorBoard to hide the steps that are about to be repeated.
        start = events.SessionLog(status=events.SessionLog.START)
        self.writer.add_event(self.event(wall_time=time.time(), step=last + 1, session_log=start))

    def add(self, row: Mapping[str, float]) -> None:
        values = [self.summary.Value(tag=k, simple_value=float(v)) for k, v in row.items()]
        self.writer.add_event(
            self.event(
                wall_time=time.time(), step=int(row["iteration"]), summary=self.summary(value=values)
            )
        )


@dataclass(frozen=True)
class Until:
    """When to stop: at the first limit reached, counted over all resumed runs."""

    minutes: Annotated[float, Range(0, infinite=True)] | None = None
    """Training time; evaluation and checkpoints do not count."""
    iterations: Annotated[int, Range(0)] | None = None
    samples: Annotated[int, Range(0)] | None = None

    def __post_init__(self) -> None:
        validate(self)
        if self.minutes is self.iterations is self.samples is None:
            raise PoiseError(
                "training needs a limit",
                "Until",
                "Give minutes, iterations or samples",
                code="limit-missing",
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
        raise PoiseError(
            f"the interval of checkpoints must be at least 1, got {every}", code="out-of-range"
        )
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
