"""Files are written so that none is lost unless it is said so, and folders are tried first."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from poise.errors import PoiseError

#: What a job does last, as `Watching.doing` is told it.
EVALUATING = "simulating every start frame"
#: What `imitate` and `track` write into their folder.
_RESULTS = (
    "simulated.*", "simulated_*.*", "body.bvh", "score.json", "report.html", "simulation.safetensors",
    "filled.*", "filled-*.*", "asked.*",
)  # fmt: skip


def may_write(path: Path, force: bool, *read: Path, flag: str = "--force") -> None:
    """Refuses to write where something would be lost, before any work is done.

    Args:
        force: an existing file may be written over.
        read: files that are read, which nothing is written over.
        flag: the option by which it may.

    Raises:
        PoiseError: a file that is there or is read; a folder, a symbolic link, a pipe or a device.
    """
    if path.is_symlink():
        raise PoiseError(
            "is a symbolic link, which a file would replace",
            path,
            "Name the file itself",
            code="is-link",
        )
    if not path.exists():
        return
    if any(source.exists() and path.samefile(source) for source in read):
        raise PoiseError(
            "the clip would be written over itself",
            path,
            "Give OUT another name",
            code="would-overwrite-source",
        )
    if path.is_dir():
        raise PoiseError("is a folder", path, "Name a file in it", code="is-folder")
    if not path.is_file():
        raise PoiseError(
            "is a pipe or a device, which a file would replace", path, "Name a file", code="not-a-file"
        )
    if not force:
        raise PoiseError(
            "is there already",
            path,
            f"Choose another name, or write over it with {flag}",
            code="would-overwrite",
        )


def may_deliver(
    folder: Path, motion: Path | None, force: bool, *read: Path, flag: str = "--force"
) -> None:
    """Refuses to write results over others, see `may_write`."""
    held = sorted(p for name in _RESULTS for p in folder.glob(name))
    for path in (*([motion] if motion else ()), *held):
        may_write(path, force, *read, flag=flag)


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
        with refusing(folder), tempfile.NamedTemporaryFile(dir=folder, prefix=".poise-") as probe:
            probe.write(b"0")
        yield
    except BaseException:
        for path in reversed(made):
            # Whatever someone else has put there in the meantime stays.
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def _make(folder: Path, made: list[Path]) -> None:
    with refusing(folder):
        missing = []
        path = folder.absolute()
        while not path.exists() and path != path.parent:
            missing.append(path)
            path = path.parent
        if not path.is_dir():
            raise PoiseError(
                f"cannot be made, since {path} is a file",
                folder,
                "Choose another folder",
                code="not-a-folder",
            )
        for path in reversed(missing):
            path.mkdir()
            made.append(path)


@contextlib.contextmanager
def refusing(path: Path) -> Iterator[None]:
    """What the system says against a path, in a sentence."""
    try:
        yield
    except (OSError, ValueError) as problem:
        reason = (getattr(problem, "strerror", None) or str(problem)).lower()
        raise PoiseError(
            f"cannot be written ({reason})", path, "Choose another folder", code="cannot-write"
        ) from None
