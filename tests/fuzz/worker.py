"""The process that reads damaged files, under a limit of memory; a crash or a hang takes it alone."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

from .oracle import Verdict, judge

#: Bytes that reading a file may take beside four times its size, and seconds until it is a hang.
BYTES, HANG = 200 << 20, 60.0
#: What is read, its files, and whether it is written and read again.
Order = tuple[str, dict[str, bytes], bool]


def work(pipe: Connection) -> None:
    """Reads what comes through the pipe, list by list; answers each file with a verdict and seconds."""
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
                begun = time.process_time()
                verdict = judge(Path(folder), name, files, again)
                after = peak()
                if (after - before) * 1024 > BYTES + 4 * sum(map(len, files.values())):
                    verdict = Verdict("memory", f"{(after - before) / 1024:.0f} MB")
                before = after
                pipe.send((verdict.kind, verdict.text, time.process_time() - begun))


def _fast() -> str | None:
    """A folder in memory, where there is one."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def _address_space() -> int:
    """Bytes that this process has reserved so far; a generous guess where that cannot be told."""
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[0]) * 4096 if told.exists() else 4 << 30


class Worker:
    """The process that reads, started again after a crash."""

    def __init__(self) -> None:
        self.context = multiprocessing.get_context("fork")
        self.start()

    def start(self) -> None:
        self.pipe, other = self.context.Pipe()
        self.process = self.context.Process(target=work, args=(other,), daemon=True)
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
