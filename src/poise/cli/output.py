"""What a verb writes: nothing that is there is lost, and folders are tried before the work starts."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from poise.errors import PoiseError


def places(out: Path) -> tuple[Path, Path | None]:
    """The folder of the results, and the file of the motion where `out` names one.

    `out` names a file where its suffix is one of a motion format: run_v1.0 is a folder.

    Raises:
        PoiseError: a format that cannot be written.
    """
    from poise.motion.io import check_writable
    from poise.motion.io.formats import READERS, WRITERS

    suffix = out.suffix.lower()
    known = {*WRITERS, ".fbx", *(s for r in READERS for s in r.suffixes)}
    if suffix not in known or out.is_dir():
        return out, None
    check_writable(out)
    return out.with_suffix(""), out


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
