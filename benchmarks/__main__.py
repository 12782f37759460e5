"""Measures suites and writes their rows into `results/`.

    python -m benchmarks SUITE [--only PART ...] [--smoke] [--again] [--compare]
    python -m benchmarks all
    python -m benchmarks list

What is there with the policy that ships and the present commit stays; a command that was stopped goes
on. --smoke tries every part for a moment on the walk that comes with Poise and writes to
`runs/benchmarks/smoke`.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from benchmarks.common.clips import Places
from benchmarks.common.runner import ROOT, SUITES, listing, run
from poise.errors import PoiseError


def arguments() -> argparse.ArgumentParser:
    """The options."""
    cache = Path.home() / ".cache/poise"
    p = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    p.add_argument("suite", choices=(*SUITES, "all", "list"))
    p.add_argument("--only", nargs="+", default=[], metavar="PART", help="parts whose names begin so")
    p.add_argument("--smoke", action="store_true", help="a moment of each part")
    p.add_argument("--again", action="store_true", help="measure also what is there")
    p.add_argument(
        "--compare", action="store_true", help="write nothing; tell figures beside those there"
    )
    p.add_argument("--workers", type=int, default=0, help="processes; by default one a core")
    p.add_argument(
        "--data",
        type=Path,
        default=Path(os.environ.get("POISE_DATA") or cache / "data"),
        metavar="FOLDER",
        help="the development set",
    )
    p.add_argument(
        "--library",
        type=Path,
        default=cache / "library",
        metavar="FOLDER",
        help="the training library, see training/README.md",
    )
    p.add_argument("--work", type=Path, default=ROOT / "runs/benchmarks", metavar="FOLDER")
    p.add_argument("--results", type=Path, default=None, metavar="FOLDER", help="of the tables")
    return p


def main(argv: list[str] | None = None) -> int:
    """Runs the suites; the exit code."""
    a = arguments().parse_args(argv)
    if a.suite == "list":
        print("\n".join(line for suite in SUITES for line in listing(suite)))
        return 0
    work = a.work / "smoke" if a.smoke else a.work
    results = a.results or (work if a.smoke else ROOT / "results")
    places = Places(a.data, a.library, work, a.smoke)
    try:
        for suite in SUITES if a.suite == "all" else (a.suite,):
            run(suite, a.only, places, results, a.workers, a.again, a.compare, _told)
    except PoiseError as problem:
        print(problem, file=sys.stderr)
        return 2
    return 0


def _told(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
