"""Hostile files, read one by one: what comes of each, in what time and memory.

python benchmarks/attack.py --json benchmarks/attack.json

Every file is made in `attack_files.py` and its siblings, by a few lines. It is read in a process of its
own, which is stopped after three minutes of processor time or at 6 GB. `ok` says that it was read or
refused in one sentence, within 30 s of processor time and 1.5 GB, or for files that are larger within
what a sound one may take: 5 s and a second a megabyte, 200 MB and four times its size. Making the file
is part of the time; memory is what was held at most while it was read, beyond what was held before.
Another call adds to the table: rows of the same name are measured anew.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import attack_files
import attack_native
import attack_rates
import attack_runs
import torch
from attack_case import CASES, HELD, held

from poise.errors import PoiseError

PARTS = (attack_files, attack_native, attack_rates, attack_runs)
SECONDS, BYTES, STOP_S, STOP_BYTES = 30.0, 1.5e9, 180, 6 << 30


def child(pipe: Connection, name: str, folder: str) -> None:
    """Makes and reads; what came of it goes into the pipe."""
    resource.setrlimit(resource.RLIMIT_CPU, (STOP_S, STOP_S))
    resource.setrlimit(resource.RLIMIT_DATA, (STOP_BYTES, STOP_BYTES))
    torch.set_num_threads(1)
    try:
        CASES[name](Path(folder))
        said = ("read", "")
    except PoiseError as error:
        said = ("refused", str(error).replace(folder + "/", ""))
    except BaseException as error:
        said = ("fault", f"{type(error).__name__}: {error}"[:300])
    own, below = (resource.getrusage(k) for k in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    seconds = own.ru_utime + own.ru_stime + below.ru_utime + below.ru_stime
    memory = max(held(most=True) - (HELD[0] if HELD else 0), below.ru_maxrss)
    size = sum(p.stat().st_size for p in Path(folder).rglob("*") if p.is_file())
    pipe.send((*said, seconds, memory * 1024, size))


def outcome(name: str) -> dict[str, Any]:
    """One row of the table."""
    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory() as folder:
        here, there = context.Pipe()
        process = context.Process(target=child, args=(there, name, folder))
        begun = time.monotonic()
        process.start()
        there.close()
        try:
            kind, said, seconds, memory, size = here.recv()
        except EOFError:
            process.join()
            kind, said, seconds, memory = f"exit code {process.exitcode}", "", float(STOP_S), 0, 0
        process.join()
    # What a sound file of that size may take.
    quick = seconds < max(SECONDS, 5 + size / 1e6)
    small = memory < max(BYTES, 4 * size + 200e6)
    fine = kind in ("read", "refused") and len(said) < 310 and quick and small
    wall = time.monotonic() - begun
    return {"what": name, "outcome": kind, "said": said, "cpu_s": round(seconds, 1),
            "wall_s": round(wall, 1), "peak_mb": round(memory / 1e6), "file_mb": round(size / 1e6, 1),
            "ok": fine}  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="part of a name")
    parser.add_argument("--missing", action="store_true", help="only what the table lacks")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, dict[str, Any]] = {}
    if args.json is not None and args.json.exists():
        rows = {r["what"]: r for r in json.loads(args.json.read_text())["rows"] if r["what"] in CASES}
    for name in CASES:
        if args.only in name and not (args.missing and name in rows):
            rows[name] = outcome(name)
            print(json.dumps(rows[name]), flush=True)
            if args.json is not None:
                told = {"rows": [rows[n] for n in CASES if n in rows]}
                args.json.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
