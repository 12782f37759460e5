"""Jobs in processes of their own: they wait, tell how far they are, can be stopped, and may crash."""

from __future__ import annotations

import contextlib
import importlib
import json
import multiprocessing
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

#: Jobs of each lane at once: looking at a file must not wait for a simulation.
LANES = {"look": 1, "work": 1}
#: s between looks at the processes; s that a job gets to stop by itself.
LOOKS_S, STOPS_S = 0.1, 4.0
#: s without a job after which a spare process prepares for the next one.
IDLE_S = 1.5
#: Bytes of progress that are looked at.
TAIL = 2000
_SHARE = re.compile(r"(\d+) % done")
#: Files that a job writes into its folder.
OUT, SAID, DRAWN = "out.json", "said.txt", "drawn.bin"


@dataclass(eq=False)
class PageJob:
    """A job: `run(*args, folder)` in a process, which writes `OUT` and `SAID` into its folder, and maybe
    `DRAWN`, see `preview.Preview`.

    Attributes:
        state: waiting, running, stopping, done, stopped or crashed.
        code: the exit code.
        share: how much is done, 0 to 1; None where that is not known.
        text: the last line that it said.
        drawn: bytes of what it has simulated so far.
    """

    id: int
    lane: str
    folder: Path
    run: Callable[..., None]
    args: tuple[Any, ...]
    ended: Callable[[PageJob], None]
    about: dict[str, Any] = field(default_factory=dict[str, Any])
    state: str = "waiting"
    code: int | None = None
    share: float | None = None
    text: str = ""
    drawn: int = 0
    began: float = 0.0
    spent: float = 0.0
    process: Any = None
    asked: float = 0.0

    def told(self) -> dict[str, Any]:
        """For the page."""
        now = time.monotonic() if self.state in ("running", "stopping") else self.began + self.spent
        return {
            "id": self.id,
            "lane": self.lane,
            "state": self.state,
            "share": self.share,
            "text": self.text,
            "drawn": self.drawn,
            "seconds": round(now - self.began, 1) if self.began else 0.0,
            **self.about,
        }

    def answer(self) -> dict[str, Any]:
        """The JSON that it wrote; empty without."""
        try:
            held = json.loads((self.folder / OUT).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return {}
        return held if isinstance(held, dict) else {}


def drawn_since(path: Path, row: int) -> bytes:
    """Frames that a job has simulated, see `preview.Preview`: the header, and the rows from one on."""
    with path.open("rb") as file:
        first = file.read(4)
        words = file.read(int.from_bytes(first, "little"))
        size = 4 * (1 + 3 * len(json.loads(words)["parents"]))
        file.seek(row * size, os.SEEK_CUR)
        rows = file.read()
    # The last one may be half written.
    return first + words + rows[: len(rows) - len(rows) % size]


class Workers:
    """Runs jobs until `close`.

    Args:
        folder: where each job has one of its own.
        preload: modules that a process knows when a job begins, which saves their import.
        heavy: modules that take seconds to import. While nothing runs, a spare process imports them for
            the next job of the lane "work", so that what is light need not wait for it.
        changed: is told, in the thread of the workers, that jobs are further than before.
        broke: is told of a fault in what a job's end did.
    """

    def __init__(
        self,
        folder: Path,
        preload: Sequence[str],
        changed: Callable[[], None],
        broke: Callable[[PageJob, Exception], None],
        heavy: Sequence[str] = (),
    ):
        self._folder, self._changed, self._broke = folder, changed, broke
        forks = "forkserver" in multiprocessing.get_all_start_methods()
        self._context: Any = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:
            self._context.set_forkserver_preload(list(preload))
        self.jobs: dict[int, PageJob] = {}
        self._count, self._stop, self._lock = 0, threading.Event(), threading.RLock()
        self._wake = threading.Event()
        self._heavy, self._idle = tuple(heavy), time.monotonic()
        #: The process that waits for work, and the end of a pipe that gives it.
        self._spare: tuple[Any, Any] | None = None
        self._thread = threading.Thread(target=self._mind, daemon=True)
        self._thread.start()

    def submit(
        self,
        lane: str,
        run: Callable[..., None],
        args: tuple[Any, ...],
        ended: Callable[[PageJob], None],
        **about: Any,
    ) -> PageJob:
        """Queues a job. ended: is told when it is over, whatever came of it. about: for the page."""
        with self._lock:
            self._count += 1
            folder = self._folder / f"job-{self._count}-{os.getpid()}"
            folder.mkdir(parents=True, exist_ok=True)
            job = PageJob(self._count, lane, folder, run, args, ended, about)
            self.jobs[job.id] = job
        self._wake.set()
        return job

    def stop(self, number: int) -> None:
        """Stops a job; what it had written into its folder is gone."""
        with self._lock:
            job = self.jobs.get(number)
            if job is None or job.state not in ("waiting", "running"):
                return
            if job.state == "waiting":
                self._over(job, "stopped")
                return
            job.state, job.asked = "stopping", time.monotonic()
            with contextlib.suppress(OSError, ValueError):
                # As Ctrl-C: what learns saves what it has.
                os.kill(job.process.pid, signal.SIGINT)
        self._wake.set()

    def close(self) -> None:
        """Ends everything that runs."""
        self._stop.set()
        self._wake.set()
        self._thread.join(10.0)
        with self._lock:
            for job in self.jobs.values():
                if job.process is not None and job.process.is_alive():
                    job.process.kill()
                    job.process.join(2.0)
                shutil.rmtree(job.folder, ignore_errors=True)
            if self._spare is not None:
                process, gives = self._spare
                gives.close()
                process.kill()
                process.join(2.0)

    @property
    def spare(self) -> int | None:
        """Number of the process that waits for work, None while there is none."""
        spare = self._spare
        return None if spare is None else spare[0].pid

    def told(self) -> list[dict[str, Any]]:
        """Jobs that wait or run, for the page."""
        with self._lock:
            return [j.told() for j in self.jobs.values()]

    def _mind(self) -> None:
        while not self._stop.is_set():
            self._wake.wait(LOOKS_S if self._busy() else 1.0)
            self._wake.clear()
            if self._look():
                self._changed()

    def _busy(self) -> bool:
        with self._lock:
            return bool(self.jobs)

    def _look(self) -> bool:
        """Starts what may start, looks at what runs; whether anything is new."""
        new = False
        with self._lock:
            jobs = list(self.jobs.values())
        if jobs:
            self._idle = time.monotonic()
        elif self._heavy and self._spare is None and time.monotonic() - self._idle > IDLE_S:
            # One that cannot begin, such as when Ctrl-C ends the process it comes from, is no loss.
            with contextlib.suppress(OSError, EOFError):
                self._spare = self._waiting()
        for job in jobs:
            if job.state in ("running", "stopping"):
                new |= self._progress(job)
            elif job.state == "waiting" and self._room(job.lane):
                self._start(job)
                new = True
        return new

    def _room(self, lane: str) -> bool:
        with self._lock:
            busy = [j for j in self.jobs.values() if j.state in ("running", "stopping")]
        return sum(j.lane == lane for j in busy) < LANES[lane]

    def _start(self, job: PageJob) -> None:
        given = job.run, job.args, str(job.folder)
        job.began, job.state = time.monotonic(), "running"
        if job.lane == "work" and self._spare is not None:
            (job.process, gives), self._spare = self._spare, None
            with contextlib.suppress(OSError):
                gives.send(given)
                gives.close()
                return
        job.process = self._context.Process(target=_begin, args=given)
        # The first start waits until what is preloaded is there.
        job.process.start()

    def _waiting(self) -> tuple[Any, Any]:
        """A process that imports what is heavy, and waits for work."""
        takes, gives = self._context.Pipe(duplex=False)
        process = self._context.Process(target=_wait, args=(takes, self._heavy))
        process.start()
        takes.close()
        return process, gives

    def _progress(self, job: PageJob) -> bool:
        before = job.text, job.share, job.state, int(time.monotonic() - job.began), job.drawn
        job.text, job.share = _said(job.folder / SAID, job.text, job.share)
        with contextlib.suppress(OSError):
            job.drawn = (job.folder / DRAWN).stat().st_size
        if job.state == "stopping" and time.monotonic() - job.asked > STOPS_S:
            job.process.kill()
        if not job.process.is_alive():
            job.process.join()
            job.code = job.process.exitcode
            ended = "crashed" if (job.code or 0) < 0 else "done"
            self._over(job, "stopped" if job.state == "stopping" else ended)
            return True
        return before != (job.text, job.share, job.state, int(job.told()["seconds"]), job.drawn)

    def _over(self, job: PageJob, state: str) -> None:
        job.state, job.spent = state, time.monotonic() - job.began if job.began else 0.0
        try:
            job.ended(job)
        except Exception as problem:
            # Whatever is wrong with one job, the others go on.
            self._broke(job, problem)
        finally:
            with self._lock:
                self.jobs.pop(job.id, None)
            if job.process is not None:
                job.process.close()
            shutil.rmtree(job.folder, ignore_errors=True)
            self._changed()


def _said(path: Path, text: str, share: float | None) -> tuple[str, float | None]:
    """The last line that a job said, and how much of its work that tells."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - TAIL))
            lines = file.read().decode("utf-8", "replace").splitlines()
    except OSError:
        return text, share
    last = next((line.strip() for line in reversed(lines) if line.strip()), text)
    found = _SHARE.search(last)
    if found:
        return last[:200], int(found[1]) / 100
    return last[:200], share if last == text else None


def _wait(takes: Any, heavy: Sequence[str]) -> None:
    """The process that waits for work; it ends when nobody is left to give any."""
    # Ctrl-C is for the server, which ends this.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for name in heavy:
        # Who needs it says what is wrong with it.
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    try:
        given = takes.recv()
    except (EOFError, OSError):
        return
    takes.close()
    _begin(*given)


def _begin(run: Callable[..., None], args: tuple[Any, ...], folder: str) -> None:
    """The work of a process: nothing of it is printed where the server was started."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        out = os.open(Path(folder) / OUT, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        said = os.open(Path(folder) / SAID, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    except OSError:
        # The server was closed before this began.
        return
    os.dup2(out, 1)
    os.dup2(said, 2)
    run(*args, Path(folder))
