"""Hostile files for `attack.py`: the table of them, and what reads a file or runs a command."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import poise
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.motion import Clip, describe

WALK = Path(poise.__file__).parent / "data/walk.bvh"
#: Makes and reads one thing in a folder, by its name.
CASES: dict[str, Callable[[Path], Any]] = {}
#: kB that a process held when it began to read.
HELD: list[int] = []


def held(most: bool = False) -> int:
    """kB that this process holds, or held at most since that was last forgotten."""
    lines, name = Path("/proc/self/status").read_text().splitlines(), "VmHWM:" if most else "VmRSS:"
    return next(int(line.split()[1]) for line in lines if line.startswith(name))


def case(name: str) -> Callable[[Callable[[Path], Any]], Callable[[Path], Any]]:
    """Registers what makes a hostile file and reads it."""

    def add(make: Callable[[Path], Any]) -> Callable[[Path], Any]:
        if name in CASES:
            raise ValueError(f"two cases are called '{name}'")
        CASES[name] = make
        return make

    return add


def read(folder: Path, name: str, data: str | bytes, **options: Any) -> Clip:
    """Writes a file and reads it as `poise info` does."""
    (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    return info(folder / name, **options)


def info(path: Path, **options: Any) -> Clip:
    """Reads a file and describes it. Memory counts from here on: making it takes some, too."""
    Path("/proc/self/clear_refs").write_text("5")
    HELD.append(held())
    clip = read_clip(path, **options)
    describe(clip)
    return clip


def command(*argv: str | Path) -> str:
    """What a command writes on the standard output.

    Raises:
        PoiseError: its sentence, where it ends with 2. RuntimeError: it ends with anything but 0 and 2.
    """
    from poise.cli.main import main

    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main([str(a) for a in argv])
    # What it was doing stands before its sentence.
    said = " ".join(err.getvalue().split()).rpartition("error: ")[2]
    if code == 2 and "Traceback" not in said:
        raise PoiseError(said, code="command-line")
    if code != 0:
        raise RuntimeError(f"exit code {code}: {said[-200:]}")
    return out.getvalue()
