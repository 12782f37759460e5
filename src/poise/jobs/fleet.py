"""Many independent trainings: a policy per clip, or a sweep, with one table in the end.

FLEET/
    fleet.json      every job: its command, state, attempts, error, score
    <job>/          what `poise imitate` writes
    logs/<job>.txt  what it said

A fleet that was stopped goes on when it is run again: finished jobs are skipped, the others resume
from their checkpoints.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from poise.errors import PoiseError
from poise.jobs.workers import WorkerExit, Workers
from poise.learn.checkpoint import write_atomic
from poise.version import __version__

FLEET_FILE = "fleet.json"
FORMAT = 1
State = Literal["waiting", "running", "done", "failed"]
Event = Literal["skipped", "started", "again", "done", "failed"]
#: The exit code of a job that is done, with a motion that was lost.
LOST = 3
_NO_SCORE = ("per_clip", "variants")


@dataclass(frozen=True)
class FleetJob:
    """One training.

    Attributes:
        name: its folder in the fleet's.
        command: arguments of Python; `--threads K` is added.
        result: the file that proves that it is done.
        facts: what the table says about it, such as clip and seed.
    """

    name: str
    command: tuple[str, ...]
    result: Path
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class Record:
    """What is known about one job; a line of the table."""

    name: str
    facts: dict[str, Any]
    command: list[str]
    state: State = "waiting"
    attempts: int = 0
    """How often it was started in the last run of the fleet."""
    error: str = ""
    """Why the last attempt failed, in one sentence."""
    seconds: float = 0.0
    """Wall time of all attempts."""
    pid: int | None = None
    """Its process, while it runs on this machine."""
    score: dict[str, Any] | None = None
    """What `score.json` says, without the parts per clip."""


@dataclass(frozen=True)
class FleetResult:
    """The jobs in the order they were given, and whether Ctrl-C ended the fleet."""

    records: tuple[Record, ...]
    interrupted: bool

    def count(self, state: State) -> int:
        """Jobs in this state."""
        return sum(r.state == state for r in self.records)


def combinations(settings: Mapping[str, Sequence[str]]) -> list[dict[str, str]]:
    """Every choice of one value per setting: `{"a": "12", "b": "3"}` has a1 b3 and a2 b3."""
    return [dict(zip(settings, v, strict=True)) for v in itertools.product(*settings.values())]


def run_fleet(
    jobs: Sequence[FleetJob],
    folder: Path,
    workers: Workers,
    retries: int = 2,
    on_event: Callable[[Event, Record], None] | None = None,
) -> FleetResult:
    """Runs all jobs that are not done yet; Ctrl-C lets the running ones save, and returns.

    If the process of a job ends with an error or is killed, the job is started again, up to `retries`
    times, and goes on from its checkpoint.

    Raises:
        PoiseError: two jobs have one name, or `folder` holds a table of another version.
    """
    if len({job.name for job in jobs}) != len(jobs):
        raise PoiseError("two jobs of the fleet have the same name", folder, code="name-repeated")
    fleet = _Fleet(jobs, folder, workers, retries, on_event or (lambda event, record: None))
    try:
        fleet.run()
        interrupted = False
    except KeyboardInterrupt:
        interrupted = True
    finally:
        # Saves what runs, also when something unexpected has happened here.
        fleet.stop()
    return FleetResult(tuple(fleet.records.values()), interrupted)


class _Fleet:
    """The state of a fleet; every change of it is written to the table at once."""

    def __init__(
        self,
        jobs: Sequence[FleetJob],
        folder: Path,
        workers: Workers,
        retries: int,
        on_event: Callable[[Event, Record], None],
    ):
        self.jobs = {job.name: job for job in jobs}
        self.folder, self.workers, self.retries, self.tell = folder, workers, retries, on_event
        known = read_table(folder)
        self.records: dict[str, Record] = {}
        for job in jobs:
            record = Record(job.name, dict(job.facts), list(job.command))
            before = known.get(job.name)
            if before is not None:
                record.seconds = before.seconds
                if before.state == "done" and before.command == record.command and job.result.exists():
                    record = before
            self.records[job.name] = record
        self.waiting = [r for r in self.records.values() if r.state != "done"]
        self.begun: dict[str, float] = {}

    def run(self) -> None:
        self.write()
        for record in self.records.values():
            if record.state == "done":
                self.tell("skipped", record)
        while self.waiting or self.begun:
            while self.waiting and len(self.begun) < self.workers.slots:
                self.start(self.waiting.pop(0))
            for ended in self.workers.ended():
                self.end(ended)

    def start(self, record: Record) -> None:
        job = self.jobs[record.name]
        record.state, record.attempts = "running", record.attempts + 1
        self.begun[record.name] = time.monotonic()
        command = (*job.command, "--threads", str(self.workers.threads))
        record.pid = self.workers.start(
            record.name, command, self.folder / "logs" / f"{record.name}.txt"
        )
        self.write()
        self.tell("started", record)

    def end(self, ended: WorkerExit) -> None:
        record, job = self.records[ended.name], self.jobs[ended.name]
        record.seconds += time.monotonic() - self.begun.pop(ended.name)
        record.pid, record.error = None, ended.said
        # A motion that is lost is a result, too.
        done = ended.code in (0, LOST)
        if done:
            record.score, record.error = _score(job.result)
        event: Event = "failed"
        if not record.error and done:
            event = "done"
        elif record.attempts <= self.retries:
            event = "again"
            self.waiting.append(record)
        record.state = "waiting" if event == "again" else event
        self.write()
        self.tell(event, record)

    def stop(self) -> None:
        try:
            self.workers.stop()
        finally:
            for name, begun in self.begun.items():
                record = self.records[name]
                record.state, record.pid = "waiting", None
                record.seconds += time.monotonic() - begun
            self.begun = {}
            self.write()

    def write(self) -> None:
        jobs = [dataclasses.asdict(r) for r in self.records.values()]
        w = self.workers
        run = {"workers": w.kind, "jobs_at_once": w.slots, "threads": w.threads}
        table = {"format": FORMAT, "poise": __version__, **run, "jobs": jobs}
        text = json.dumps(table, indent=2, allow_nan=False)
        write_atomic(self.folder / FLEET_FILE, text.encode())


def read_table(folder: Path) -> dict[str, Record]:
    """The jobs of a fleet by name, as its table has them; empty where there is none.

    Raises:
        PoiseError: the table is damaged or of another version.
    """
    path = folder / FLEET_FILE
    if not path.exists():
        return {}
    try:
        table = json.loads(path.read_bytes())
        if table["format"] != FORMAT:
            raise ValueError
        return {entry["name"]: Record(**entry) for entry in table["jobs"]}
    except (ValueError, KeyError, TypeError):
        raise PoiseError(
            "the table of the fleet is damaged or of another version",
            path,
            "Choose another folder",
            code="file-damaged",
        ) from None


def _score(path: Path) -> tuple[dict[str, Any] | None, str]:
    """The figures of a result, and what is wrong with it."""
    try:
        score = json.loads(path.read_bytes())
    except OSError:
        return None, f"it ended well, but {path} cannot be seen here: workers must share that folder"
    except ValueError:
        return None, f"{path} is damaged"
    return {k: v for k, v in score.items() if k not in _NO_SCORE}, ""
