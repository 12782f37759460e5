"""The policy that comes with Poise, alone and with lookahead, on sets of clips, without help.

    python benchmarks/lookahead.py --data FOLDER --clips LIBRARY --json FILE [--set bandai cmu ...]
        [--every N] [--controllers nothing policy lookahead] [--budgets 64x12 192]
        [--conditions none pushes ...] [--starts 8] [--workers 2]

"nothing" is the null: action 0, which aims at the motion's own joint angles. With --starts N every clip
is begun N times, with joints that are off by 1 mrad (`eval.perturb`). Sets of FOLDER are bandai (without
four styles), bandai-test (those), bandai-all, cmu and dances; "library" and "held-out" are the clips of
LIBRARY that the policy learned from, and those of the subjects that were held out. --conditions are what
goes wrong (`lookahead_sets.CONDITIONS`; "all": each of them).

FILE grows clip by clip: what it holds is not measured again but for --again, so that a run that was
stopped goes on, and other sets, budgets and conditions come beside. Figures of another policy, or of
other settings of lookahead, are measured anew. Next to it lie FILE.md, all tables, and the budget curve.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
import sys
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from lookahead_figures import KEY
from lookahead_measure import measured
from lookahead_sets import CONDITIONS, FILES, LIBRARIES, budgets_of, clips_of
from lookahead_text import write

from poise.errors import PoiseError
from poise.jobs.tracker import SHIPPED
from poise.learn.checkpoint import write_atomic
from poise.motion import Clip
from poise.plan import LookaheadConfig

CONTROLLERS = ("nothing", "policy", "lookahead")


class Job(NamedTuple):
    """One clip with one controller; `key` is what its row is known by."""

    key: tuple[Any, ...]
    source: Path | Clip
    config: LookaheadConfig


class Results:
    """The rows of a file; a new one takes the place of the one with its key."""

    def __init__(self, path: Path):
        self.path = path
        old = json.loads(path.read_text()) if path.exists() else {}
        self.commands: list[str] = old.get("commands", [])
        self.rows: list[dict[str, Any]] = old.get("rows", [])

    def has(self, job: Job) -> bool:
        """Whether a job was measured with this policy and these settings."""
        made = made_with(job.key[2], job.config)
        return any(_key(row) == job.key and row["made_with"] == made for row in self.rows)

    def add(self, row: dict[str, Any]) -> None:
        """One row more, in the file at once."""
        self.rows = [r for r in self.rows if _key(r) != _key(row)] + [row]
        self.save()

    def save(self) -> None:
        """The file, with a line for each row."""
        head = {"commands": self.commands, "machine": platform.machine()}
        text = json.dumps(head, indent=1, allow_nan=False).rstrip("}").rstrip()
        lines = ",\n".join(f"  {json.dumps(r, allow_nan=False)}" for r in self.rows)
        write_atomic(self.path, f'{text},\n "rows": [\n{lines}\n ]\n}}\n'.encode())


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[k] for k in KEY)


def made_with(controller: str, config: LookaheadConfig) -> str:
    """A hash of what decides the figures of a controller: the policy, and the settings of lookahead."""
    # The budget stands in the row.
    plain = LookaheadConfig()
    config = replace(config, candidates=plain.candidates, horizon=plain.horizon)
    settings = json.dumps(asdict(config)) if controller == "lookahead" else ""
    return hashlib.sha256(SHIPPED.read_bytes() + settings.encode()).hexdigest()[:16]


def jobs_of(a: argparse.Namespace) -> Iterator[Job]:
    """What is to be measured: shorter sets of controllers first, so that tables grow evenly."""
    budgets = budgets_of(a.budgets)
    wanted = list(CONDITIONS) if "all" in a.conditions else a.conditions
    for name in a.set:
        clips = clips_of(name, a.data, a.clips, a.cache or a.json.parent / "cache")
        for clip in sorted(clips)[:: a.every]:
            for condition in wanted:
                for controller in a.controllers:
                    # Only a planner has a model of its own.
                    if CONDITIONS[condition].of_planner and controller != "lookahead":
                        continue
                    for budget in budgets if controller == "lookahead" else [""]:
                        config = budgets.get(budget, LookaheadConfig())
                        config = replace(config, seed=a.seed, jerk_price=a.jerk_price)
                        key = (name, clip, controller, budget, condition, a.starts)
                        yield Job(key, clips[clip], config)


def main(argv: list[str] | None = None) -> None:
    """Measures, row by row, and writes the tables."""
    a = arguments().parse_args(argv)
    results = Results(a.json)
    jobs = [job for job in jobs_of(a) if a.again or not results.has(job)]
    words = [w.rpartition("/")[2] if w.startswith(("/", "~")) else w for w in argv or sys.argv[1:]]
    command = "python benchmarks/lookahead.py " + " ".join(f'"{w}"' if " " in w else w for w in words)
    results.commands += [] if command in results.commands else [command]
    print(f"{len(jobs)} to measure, {len(results.rows)} rows are there", flush=True)
    running: dict[Future[dict[str, Any]], Job] = {}
    # A forked child may wait for threads that it does not have.
    with ProcessPoolExecutor(a.workers, get_context("spawn")) as pool:
        for job in jobs:
            _, clip, controller, _, condition, starts = job.key
            what = (clip, job.source, controller, job.config, CONDITIONS[condition], starts)
            running[pool.submit(measured, *what)] = job
        while running:
            for one in wait(running, return_when=FIRST_COMPLETED).done:
                job = running.pop(one)
                row: dict[str, Any] = dict(zip(KEY, job.key, strict=True))
                row["made_with"] = made_with(job.key[2], job.config)
                row |= one.result()
                results.add(row)
                whole = sum(e["whole"] for e in row["episodes"])
                print(*job.key[:5], f"{whole} of {len(row['episodes'])}", sep=", ", flush=True)
    results.save()
    for path in write(results.rows, results.commands, a.json):
        print(path)


def arguments() -> argparse.ArgumentParser:
    """The options."""
    p = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    p.add_argument("--data", type=Path, metavar="FOLDER")
    p.add_argument("--clips", type=Path, metavar="LIBRARY", help="of the sets library and held-out")
    p.add_argument("--json", type=Path, required=True, metavar="FILE")
    p.add_argument("--set", nargs="+", choices=(*FILES, *LIBRARIES), default=["bandai", "cmu", "dances"])
    p.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th clip")
    p.add_argument("--controllers", nargs="+", choices=CONTROLLERS, default=list(CONTROLLERS))
    p.add_argument("--budgets", nargs="+", default=["192"], metavar="BUDGET")
    p.add_argument("--conditions", nargs="+", choices=(*CONDITIONS, "all"), default=["none"])
    p.add_argument("--starts", type=int, default=1, metavar="N")
    p.add_argument("--seed", type=int, default=0, help="of the draws of lookahead, at the first start")
    price = LookaheadConfig.jerk_price
    p.add_argument("--jerk-price", type=float, default=price, metavar="X", help="of lookahead")
    p.add_argument("--workers", type=int, default=2)
    p.add_argument("--cache", type=Path, help="a folder for the library that is read")
    p.add_argument("--again", action="store_true", help="measure also what FILE holds")
    return p


if __name__ == "__main__":
    try:
        main()
    except PoiseError as problem:
        sys.exit(str(problem))
