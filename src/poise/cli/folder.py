"""A folder as input: each of its files on its own, one that fails stops no other, a table at the end."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from poise.cli.answer import INTERRUPTED, LOST, REFUSED, Answer, document, failure
from poise.cli.console import say, table, tell
from poise.errors import PoiseError


def clips_in(given: Sequence[Path], out: Path | None = None) -> list[tuple[str, Path]]:
    """Every motion file in files and folders, with a name of its own; results below `out` are none.

    Raises:
        PoiseError: no such file, or no motion in it.
    """
    from poise.jobs.library.files import is_motion, refuse_without_motion

    found: list[tuple[str, Path]] = []
    for path in given:
        if not path.exists():
            raise PoiseError("there is no such file or folder", path, "Give a folder of motion files")
        root = path.absolute()
        files = [root] if path.is_file() else sorted(f for f in root.rglob("*") if is_motion(f))
        base = root.parent if path.is_file() else root
        found += [
            ("-".join(f.relative_to(base).with_suffix("").parts), f)
            for f in files
            if out is None or not f.is_relative_to(out)
        ]
    if not found:
        refuse_without_motion(given)
    seen: dict[str, int] = {}
    named = []
    for name, path in found:
        seen[name] = seen.get(name, 0) + 1
        named.append((name if seen[name] == 1 else f"{name}-{seen[name]}", path))
    return named


def each(
    verb: str, given: Sequence[Path], out: Path | None, one: Callable[[Path, str], Answer]
) -> Answer:
    """Runs `one(file, name)` for every motion file in `given`, and shows the table.

    Exit code 1 if a file met a fault of Poise, else 2 if any was refused, else 3 if any motion was lost.
    """
    files = clips_in(given, None if out is None else out.absolute())
    done, rows, problems = [], [], []
    for k, (name, path) in enumerate(files):
        began, problem = time.monotonic(), None
        with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(nowhere):
            try:
                answer = one(path, name)
            except (KeyboardInterrupt, Exception) as failed:
                code, problem = failure(failed)
                answer = Answer(exit_code=code, outcome="refused" if code == REFUSED else "failed")
                problems.append(str(problem))
        if answer.exit_code == INTERRUPTED:
            tell(f"Stopped; {k} of {len(files)} files are done.")
            break
        seconds = time.monotonic() - began
        tell(f"{k + 1} of {len(files)}  {name}: {answer.outcome}", "dim")
        figure = "-" if answer.error_mm is None else f"{answer.error_mm:.0f}"
        rows.append((name, answer.outcome, figure, f"{seconds:.1f}"))
        done.append({**document(verb, [path], answer, problem), "seconds": seconds})
    tracked = verb == "track"
    columns = ("file", "outcome", *(("error mm",) if tracked else ()), "seconds")
    table("", columns, rows if tracked else [(r[0], r[1], r[3]) for r in rows], left=2)
    for sentence in problems:
        say(sentence)
    codes = {d["exit_code"] for d in done}
    code = next((c for c in (1, REFUSED, LOST) if c in codes), 0)
    code = code if len(done) == len(files) else INTERRUPTED
    return Answer({"files": done}, {} if out is None else {"folder": out}, exit_code=code)
