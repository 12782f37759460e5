"""One page for a project at a time: a file that the system keeps locked while its process lives."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from pathlib import Path
from typing import Any

from poise.errors import PoiseError

#: The file, in the folder of a project.
LOCK = ".lock"
_TAKEN = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)


class ProjectLock:
    """Holds a project's folder until `release`, or until the process ends, however it ends.

    The file says which process holds it, and at which address its page is; the lock itself is the
    system's, so that one which a dead process left behind holds nobody off.

    Raises:
        PoiseError: another page has the folder.
    """

    def __init__(self, folder: Path):
        self._path = folder / LOCK
        self._file: int | None = None
        while self._file is None:
            try:
                file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
            except OSError as problem:
                why = f"cannot be written ({(problem.strerror or '').lower()})"
                raise PoiseError(why, folder, "Choose another folder", code="cannot-write") from None
            try:
                _take(file)
            except OSError as problem:
                held = _said(file)
                os.close(file)
                if problem.errno in _TAKEN:
                    raise _in_use(folder, held) from None
                # A disk that knows no locks, such as some of a network, holds nobody off.
                return
            if _same(file, self._path):
                self._file = file
            else:
                # Whoever had it took the file away in this moment.
                os.close(file)
        self.tell()

    def tell(self, address: str = "") -> None:
        """Says in the file who holds it, and at which address."""
        if self._file is not None:
            words = json.dumps({"process": os.getpid(), "address": address}).encode()
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, 0)
                os.pwrite(self._file, words, 0) if hasattr(os, "pwrite") else os.write(self._file, words)

    def release(self) -> None:
        """Lets others have it."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
            os.close(self._file)
            self._file = None


def _take(file: int) -> None:
    """Locks a file without waiting.

    Raises:
        OSError: somebody has it.
    """
    try:
        import fcntl
    except ImportError:
        import msvcrt

        lock: Any = msvcrt
        # A byte behind what the file says, which others may read.
        os.lseek(file, 4096, os.SEEK_SET)
        lock.locking(file, lock.LK_NBLCK, 1)
        os.lseek(file, 0, os.SEEK_SET)
        return
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _same(file: int, path: Path) -> bool:
    with contextlib.suppress(OSError):
        mine, there = os.fstat(file), path.stat()
        return (mine.st_dev, mine.st_ino) == (there.st_dev, there.st_ino)
    return False


def _said(file: int) -> dict[str, Any]:
    with contextlib.suppress(OSError, ValueError, RecursionError):
        os.lseek(file, 0, os.SEEK_SET)
        held = json.loads(os.read(file, 4096))
        return held if isinstance(held, dict) else {}
    return {}


def _in_use(folder: Path, held: dict[str, Any]) -> PoiseError:
    process, address = held.get("process"), held.get("address")
    who = f" by process {process}" if process else ""
    where = f" at {address}" if address else ""
    return PoiseError(
        f"is open already{who}{where}",
        folder,
        "Go to that page or end it, or choose another folder with --project",
        code="project-in-use",
    )
