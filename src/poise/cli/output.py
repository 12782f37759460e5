"""Result folders: tried out before the work starts, and left as they were if it cannot start."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from poise.errors import PoiseError


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Makes `folder` and proves that files can be written in it.

    If the body of the `with` fails, the folders that were made here are removed again.

    Raises:
        PoiseError: the folder cannot be made or written.
    """
    made: list[Path] = []
    try:
        _make(folder, made)
        with _refusing(folder), tempfile.NamedTemporaryFile(dir=folder, prefix=".poise-") as probe:
            probe.write(b"0")
        yield
    except BaseException:
        for path in reversed(made):
            # Whatever someone else has put there in the meantime stays.
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def _make(folder: Path, made: list[Path]) -> None:
    with _refusing(folder):
        missing = []
        path = folder.absolute()
        while not path.exists() and path != path.parent:
            missing.append(path)
            path = path.parent
        if not path.is_dir():
            raise PoiseError(f"cannot be made, since {path} is a file", folder, "Choose another folder")
        for path in reversed(missing):
            path.mkdir()
            made.append(path)


@contextlib.contextmanager
def _refusing(folder: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError) as problem:
        reason = (getattr(problem, "strerror", None) or str(problem)).lower()
        raise PoiseError(f"cannot be written ({reason})", folder, "Choose another folder") from None


def run_folder(path: Path) -> Path:
    """The run folder that `path` names: itself, or the `run` folder inside a result.

    Raises:
        PoiseError: there is no such folder.
    """
    # The name of the run file stands in poise.jobs.runs, whose import takes seconds.
    from poise.jobs.runs import RUN_FILE

    if not path.exists():
        raise PoiseError("there is no such folder", path, "Give the folder of a result or a run")
    inner = path / "run"
    return inner if not (path / RUN_FILE).exists() and (inner / RUN_FILE).exists() else path
