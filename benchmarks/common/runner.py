"""Runs the parts of suites: one process a core, each measurement kept as soon as it is made.

A part is a list of units, a function that measures one of them, and a function that makes rows of all.
What a unit gave lies in `runs/benchmarks/SUITE.jsonl` until its part is whole, under the policies and
the commit that it was measured with, so that a command that was stopped goes on where it was. Rows of a
part that stand in `results/` with the present policies and commit are not made again.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import resource
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from benchmarks.common.clips import Places
from benchmarks.common.machine import cores
from benchmarks.common.policies import ROOT, stated
from benchmarks.common.rows import Figure, Row, between, mean_of, merge, read, short
from poise.errors import PoiseError

__all__ = ["ROOT", "Figure", "Part", "Places", "between", "mean_of", "run"]

Raws = Mapping[str, Any]


@dataclass(frozen=True)
class Part:
    """A table's worth of measurements.

    Attributes:
        about: what it measures, in a line.
        units: the names of its measurements.
        measure: makes one of them: plain JSON values.
        rows: figures of all.
        policies: kinds of shipped policies that they are of, see `policies.FILES`.
        alone: its times count, so that nothing else may run beside it.
        hours: of one core, about.
        needs: "data", "library", "gpu" or packages, without which it is left out (but in a smoke test).
    """

    about: str
    units: Callable[[Places], Sequence[str]]
    measure: Callable[[Places, str], Any]
    rows: Callable[[Places, Raws], Iterable[Figure]]
    policies: tuple[str, ...] = ()
    alone: bool = False
    hours: float = 0.0
    needs: tuple[str, ...] = ("data",)


#: Suites by name, and their modules.
SUITES = {
    name: f"benchmarks.suites.{name.replace('-', '_')}"
    for name in (
        "engine",
        "gpu",
        "read",
        "attack",
        "retarget-repair",
        "track",
        "lookahead-search",
        "recover",
        "imitate",
        "inbetween-complete",
        "dream",
        "scenes",
        "live",
        "papers",
    )
}


def parts_of(suite: str) -> dict[str, Part]:
    """The parts of a suite by name."""
    return import_module(SUITES[suite]).PARTS


@cache
def commit() -> str:
    """The last commit that changed what is measured or how; with "+" where files differ from it."""
    try:
        told = subprocess.run(
            ["git", "log", "-1", "--format=%h", "--", "src", "benchmarks"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        changed = subprocess.run(
            ["git", "status", "--porcelain", "--", "src", "benchmarks"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{told}+" if changed else told


def command_of(suite: str, part: str) -> str:
    """The command that makes the rows of a part, as they state it."""
    return f"python -m benchmarks {suite} --only {shlex.quote(part)}"


@dataclass
class Store:
    """Results of units, in a file that grows line by line."""

    path: Path
    made_with: str
    raws: dict[tuple[str, str], Any] = field(default_factory=dict)
    hours: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.path.exists():
            return
        for line in self.path.read_text("utf-8").splitlines():
            try:
                row = json.loads(line)
            except ValueError:
                # The command was killed in the middle of its last line.
                continue
            if row["with"] == self.made_with:
                self._take(row)

    def _take(self, row: dict[str, Any]) -> None:
        self.raws[row["part"], row["unit"]] = row["raw"]
        self.hours[row["part"]] = self.hours.get(row["part"], 0.0) + row["core_s"] / 3600

    def add(self, part: str, unit: str, raw: Any, core_s: float) -> None:
        """One unit more, in the file at once."""
        row = {
            "with": self.made_with,
            "part": part,
            "unit": unit,
            "core_s": round(core_s, 2),
            "raw": raw,
        }
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        self._take(row)


def _spent() -> float:
    return sum(
        u.ru_utime + u.ru_stime
        for u in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def measured(suite: str, part: str, unit: str, places: Places) -> tuple[Any, float]:
    """One unit and its core seconds; runs in a process of its own."""
    torch.set_num_threads(1)
    begun = _spent()
    raw = parts_of(suite)[part].measure(places, unit)
    # As the store has it: what JSON makes of keys and tuples, rows are made of.
    return json.loads(json.dumps(raw)), _spent() - begun


def missing(part: Part, places: Places) -> str:
    """The thing that a part lacks here; "" for nothing."""
    packages = [n for n in part.needs if n not in ("data", "library", "gpu")]
    if not places.smoke:
        if "data" in part.needs and not (places.data / "INDEX.tsv").exists():
            return f"the development set ({places.data})"
        if "library" in part.needs and not places.library.is_dir():
            return f"the training library ({places.library})"
        if "gpu" in part.needs and not torch.cuda.is_available():
            return "a GPU"
    for name in packages:
        try:
            import_module(name)
        except ImportError:
            return f"the package {name}"
    return ""


def chosen(suite: str, only: Sequence[str]) -> dict[str, Part]:
    """The parts whose names begin so; all for none.

    Raises:
        PoiseError: a name that no part begins with.
    """
    parts = parts_of(suite)
    for name in only:
        if not any(p.startswith(name) for p in parts):
            known = ", ".join(parts)
            raise PoiseError(
                f"no part of {suite} is called '{name}'", hint=f"Parts: {known}", code="unknown-choice"
            )
    # The whole name of a part is that part alone, also where others begin so.
    whole = {name for name in only if name in parts}
    begun = tuple(name for name in only if name not in parts)
    return {n: p for n, p in parts.items() if not only or n in whole or (begun and n.startswith(begun))}


def kind(part: Part) -> object:
    """The thing that tells measurements apart in a smoke test, where every set of clips is the walk."""
    measure = part.measure
    if not isinstance(measure, partial):
        return measure
    return measure.func, {k: v for k, v in measure.keywords.items() if k != "of_set"}


def rows_of(suite: str, name: str, part: Part, places: Places, store: Store) -> list[Row]:
    """The rows of a part that is whole."""
    raws = {u: store.raws[name, u] for u in part.units(places)}
    policy, hours = stated(part.policies), short(store.hours.get(name, 0.0))
    where = f"{platform.machine()}, {cores()} cores"
    if torch.cuda.is_available():
        where += f", {torch.cuda.get_device_name()}"
    out = []
    for f in part.rows(places, raws):
        told = policy if f.policy is None else f.policy
        out.append(
            Row(
                f.subject,
                f.metric,
                short(f.value),
                f.spread,
                str(f.n),
                str(f.seeds),
                told,
                commit(),
                command_of(suite, name),
                hours,
                where,
            )
        )
    return out


def run(
    suite: str,
    only: Sequence[str],
    places: Places,
    results: Path,
    workers: int = 0,
    again: bool = False,
    compare: bool = False,
    tell: Callable[[str], None] = print,
) -> list[Row]:
    """Measures what is missing of a suite and writes its rows; those that were made.

    Args:
        only: parts by the beginnings of their names; all for none.
        results: the folder of tables.
        workers: processes; 0 takes one a core.
        again: measure also what is there.
        compare: write nothing, and tell each figure beside the one that is there.
    """
    table, made = results / f"{suite}.csv", list[Row]()
    before = {row.key: row for row in read(table)}
    for name, part in chosen(suite, only).items():
        if lacks := missing(part, places):
            tell(f"{suite}, {name}: left out, it needs {lacks}")
            continue
        with_ = json.dumps([stated(part.policies), commit(), places.smoke])
        there = [r for r in before.values() if r.command == command_of(suite, name)]
        # Rows of what was trained for a table state no policy that ships.
        current = there and all(
            r.commit == commit() and (r.policy in ("", stated(part.policies)) or " (" in r.policy)
            for r in there
        )
        if current and not (again or compare or places.smoke):
            tell(f"{suite}, {name}: {len(there)} rows are there")
            continue
        store = Store(places.work / f"{suite}.jsonl", with_)
        if again or compare:
            for key in [k for k in store.raws if k[0] == name]:
                del store.raws[key]
            store.hours.pop(name, None)
        _measure(suite, name, part, places, store, 1 if part.alone else workers or cores(), tell)
        rows = rows_of(suite, name, part, places, store)
        made += rows
        for row in rows if compare else ():
            was = before.get(row.key)
            beside = f", before {was.value} ({was.commit})" if was else ""
            tell(f"{row.subject}, {row.metric}: {row.value}{beside}")
        if not compare:
            merge(table, rows, command_of(suite, name))
            tell(f"{suite}, {name}: {len(rows)} rows in {table.name}")
    return made


def _measure(
    suite: str,
    name: str,
    part: Part,
    places: Places,
    store: Store,
    workers: int,
    tell: Callable[[str], None],
) -> None:
    left = [u for u in part.units(places) if (name, u) not in store.raws]
    if not left:
        return
    tell(f"{suite}, {name}: {len(left)} to measure, {part.about}")

    def keep(unit: str, raw: Any, spent: float) -> None:
        store.add(name, unit, raw, spent)
        tell(f"{suite}, {name}: {unit}, {spent:.1f} s")

    if places.smoke or workers == 1:
        # Parts that differ only in their clips are measured once in a smoke test.
        same = [n for n, p in parts_of(suite).items() if places.smoke and kind(p) == kind(part)]
        for unit in left:
            there = [store.raws[n, unit] for n in same if (n, unit) in store.raws]
            keep(unit, *((there[0], 0.0) if there else measured(suite, name, unit, places)))
        return
    # A forked child may wait for threads that it does not have.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(min(workers, len(left)), multiprocessing.get_context("spawn")) as pool:
        running = {pool.submit(measured, suite, name, unit, places): unit for unit in left}
        try:
            for one in as_completed(running):
                keep(running[one], *one.result())
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def script(*argv: str | Path) -> float:
    """Runs a script of `benchmarks/` to its end; its seconds.

    Raises:
        RuntimeError: it ended with an error.
    """
    begun = time.monotonic()
    done = subprocess.run([sys.executable, *map(str, argv)], cwd=ROOT, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, argv))} ended with {done.returncode}")
    return time.monotonic() - begun


def listing(suite: str) -> list[str]:
    """A line for each part."""
    lines = []
    for name, p in parts_of(suite).items():
        needs = f", needs {', '.join(p.needs)}" if p.needs else ""
        lines.append(f"{command_of(suite, name)}: {p.about} (about {p.hours:g} core-hours{needs})")
    return lines
