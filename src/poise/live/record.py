"""Recording: every frame is on disk within a second, and becomes BVH, GLB or CSV when it ends."""

from __future__ import annotations

import os
import queue
import threading
import time
from pathlib import Path
from typing import TextIO

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.formats.own import csv_text
from poise.formats.table import check_writable
from poise.kinematics import qpos_to_clip
from poise.motion import Clip

#: Frames that wait for the disk at most, and s between two writes.
WAIT, EVERY_S = 900, 0.4


class CharacterRecorder:
    """Records characters of one body.

    Each goes into a CSV of Poise's own, NAME-1.csv for the first of several, which a file of the suffix
    that was asked for replaces at the end. What a crash leaves is that CSV, which `poise convert` reads.

    Args:
        path: of the motion, .bvh, .glb, .csv or another that is written.
        example: a clip on the body's skeleton.

    Attributes:
        missed: frames for which the disk was too slow.

    Raises:
        PoiseError: a format that cannot be written.
    """

    def __init__(self, path: Path, table: BodyTable, example: Clip, count: int, rate_hz: float):
        check_writable(path)
        self.path, self.table, self.example = Path(path), table, example
        self.count, self.rate_hz, self.missed, self.frames = count, rate_hz, 0, 0
        self._paths: list[Path] = []
        self._waiting: queue.Queue[np.ndarray | None] | None = None
        self._thread: threading.Thread | None = None
        self.takes = 0
        self.problem = ""

    @property
    def on(self) -> bool:
        """Whether it records."""
        return self._thread is not None

    def start(self) -> None:
        """Begins a take."""
        if self.on:
            return
        self.takes += 1
        self._waiting, self.frames = queue.Queue(WAIT), 0
        self._paths = [self._named(k) for k in range(self.count)]
        self._thread = threading.Thread(target=self._write, args=(self._waiting,), daemon=True)
        self._thread.start()

    def write(self, qpos: np.ndarray) -> None:
        """One frame `(K, 7 + n)`; returns at once."""
        if self._waiting is None:
            return
        try:
            self._waiting.put_nowait(qpos)
            self.frames += 1
        except queue.Full:
            self.missed += 1

    def stop(self) -> list[Path]:
        """Ends the take; the files that hold it."""
        if self._waiting is None or self._thread is None:
            return []
        self._waiting.put(None)
        self._thread.join()
        self._waiting = self._thread = None
        out = list[Path]()
        for raw in self._paths:
            if not raw.exists() or self.frames < 2:
                raw.unlink(missing_ok=True)
                continue
            final = raw.with_suffix(self.path.suffix)
            if final != raw:
                write_clip(read_clip(raw), final)
                raw.unlink()
            out.append(final)
        return out

    def _named(self, k: int) -> Path:
        """A name that is free."""
        stem = self.path.stem + (f"-{k + 1}" if self.count > 1 else "")
        for take in range(1, 10_000):
            more = "" if take == 1 else f"-take{take}"
            paths = [self.path.with_name(f"{stem}{more}{s}") for s in (".csv", self.path.suffix)]
            if not any(p.exists() for p in paths):
                return paths[0]
        raise PoiseError("ten thousand takes lie there already", self.path, code="over-limit")

    def _write(self, waiting: queue.Queue[np.ndarray | None]) -> None:
        files, made, rows, due = list[TextIO](), 0, list[np.ndarray](), time.monotonic() + EVERY_S
        try:
            ended = False
            while not ended:
                try:
                    row = waiting.get(timeout=0.1)
                    ended = row is None
                    if row is not None:
                        rows.append(row)
                except queue.Empty:
                    pass
                if len(rows) < 2 or not (ended or time.monotonic() >= due):
                    continue
                due = time.monotonic() + EVERY_S
                block = np.stack(rows)
                if not files:
                    files = [p.open("w", encoding="utf-8") for p in self._paths]
                for k, file in enumerate(files):
                    file.write(self._lines(block[:, k], made, header=made == 0))
                    file.flush()
                    os.fsync(file.fileno())
                made, rows = made + len(rows), []
        except OSError as problem:
            self.problem = f"the recording ended: {problem.strerror}"
        finally:
            for file in files:
                file.close()

    def _lines(self, qpos: np.ndarray, first: int, header: bool) -> str:
        """Rows of the CSV, see `poise.formats.own`; with the lines before them for the first."""
        like = self.example.replaced(
            root_pos=qpos[:, :3], rot=self.example.rot[:1].repeat(len(qpos), 0), fps=self.rate_hz
        )
        clip = qpos_to_clip(qpos, self.table, self.example.skeleton, self.rate_hz, like, "live")
        return csv_text(clip, first, header)
