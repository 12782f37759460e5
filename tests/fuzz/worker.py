"""The process that reads damaged files, under a limit of memory; a crash or a hang takes it alone."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import tempfile
import time
import traceback
from collections.abc import Iterable
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

import torch

from .native import fork_instead
from .oracle import Verdict, judge

#: Bytes that reading a file may take beside four times its size.
BYTES = 200 << 20
#: Seconds of the processor until Python code is stopped, and of the clock until the process is.
BUSY, HANG = 15.0, 240.0
#: What is read, its files, and whether it is written and read again.
Order = tuple[str, dict[str, bytes], bool]


class _TooLongError(BaseException):
    """A file took more than `BUSY` seconds: where it was."""


def _stop(number: int, frame: FrameType | None) -> None:
    at = [
        f"{Path(f.filename).name}:{f.lineno}"
        for f in traceback.extract_stack(frame)
        if "poise" in f.filename
    ]
    raise _TooLongError(at[-1] if at else "?")


def work(pipe: Connection, parents: Connection, formats: Iterable[str]) -> None:
    """Reads what comes through the pipe, list by list; answers each file with a verdict and seconds.

    parents: the pipe's other end, closed here, so that this process ends with its parent.
    """
    parents.close()
    # The threads of a process do not come along when it forks: what asks for them waits for ever.
    torch.set_num_threads(1)
    fork_instead(formats)
    # The libraries' own objects are many: they are never looked through for garbage again.
    gc.freeze()
    timed = hasattr(signal, "setitimer")
    if timed:
        signal.signal(signal.SIGPROF, _stop)
    try:
        import resource
    except ImportError:
        resource = None  # type: ignore[assignment]
    else:
        resource.setrlimit(resource.RLIMIT_AS, (_address_space() + (2 << 30),) * 2)

    def peak() -> int:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss if resource else 0

    before = peak()
    with tempfile.TemporaryDirectory(dir=_fast()) as folder:
        while (orders := pipe.recv()) is not None:
            for name, files, again in orders:
                begun = _busy()
                if timed:
                    signal.setitimer(signal.ITIMER_PROF, BUSY)
                try:
                    verdict = judge(Path(folder), name, files, again)
                except _TooLongError as late:
                    verdict = Verdict("hang", f"{late} after {BUSY:.0f} s")
                if timed:
                    signal.setitimer(signal.ITIMER_PROF, 0)
                after = peak()
                if (after - before) * 1024 > BYTES + 4 * sum(map(len, files.values())):
                    verdict = Verdict("memory", f"{(after - before) / 1024:.0f} MB")
                before = after
                pipe.send((verdict.kind, verdict.text, _busy() - begun))


def _orders(pipe: Connection) -> list[Order]:
    """The next files; none where the parent has ended."""
    try:
        return pipe.recv()
    except EOFError:
        return []


def _busy() -> float:
    """Seconds of the processor that this process and its children have taken."""
    took = os.times()
    return time.process_time() + took.children_user + took.children_system


def _fast() -> str | None:
    """A folder in memory, where there is one."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def _address_space() -> int:
    """Bytes that this process has reserved so far; a generous guess where that cannot be told."""
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[0]) * 4096 if told.exists() else 4 << 30


class Worker:
    """The process that reads, started again after a crash."""

    def __init__(self, formats: Iterable[str] = ()) -> None:
        self.context, self.formats = multiprocessing.get_context("fork"), tuple(formats)
        self.start()

    def start(self) -> None:
        self.pipe, other = self.context.Pipe()
        self.process = self.context.Process(
            target=work, args=(other, self.pipe, self.formats), daemon=True
        )
        self.process.start()
        other.close()

    def judge(self, orders: list[Order]) -> list[tuple[Verdict, float]]:
        """Each file's verdict and the seconds of processor time; "crash" or "hang" where none came."""
        told: list[tuple[Verdict, float]] = []
        while len(told) < len(orders):
            try:
                self.pipe.send(orders[len(told) :])
                while len(told) < len(orders) and self.pipe.poll(HANG):
                    kind, text, seconds = self.pipe.recv()
                    told.append((Verdict(kind, text), seconds))
                if len(told) == len(orders):
                    break
                verdict = Verdict("hang", f"{HANG:.0f} s")
            except (EOFError, OSError):
                self.process.join(5)
                verdict = Verdict("crash", f"exit code {self.process.exitcode}")
            told.append((verdict, HANG))
            self.close()
            self.start()
        return told

    def close(self) -> None:
        """Ends the process."""
        self.process.kill()
        self.process.join()
