"""Training logs on this machine: a CSV table and TensorBoard's event files."""

from __future__ import annotations

import csv
import io
import os
import time
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from poise.learn.checkpoint import write_atomic

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
