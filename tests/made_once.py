"""What is costly and always the same, such as a trained toy policy, is made once and kept for later.

It lies in a folder under the system's temporary one, by a digest of the sources of Poise and of the
tests' helpers, of the versions of torch and MuJoCo and of what is asked for; so a changed line makes it
anew. Processes that want the same wait for the first.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import poise

with suppress(ImportError):
    # Without it, on Windows, two processes may make the same; one of them is kept.
    import fcntl

TESTS = Path(__file__).resolve().parent
#: What was not used for so long is removed, in seconds.
KEPT = 86_400.0


@functools.cache
def _digest() -> str:
    found = hashlib.sha256(" ".join(version(name) for name in ("torch", "mujoco", "numpy")).encode())
    package = Path(poise.__file__).parent
    helpers = [f for f in TESTS.rglob("*.py") if not f.name.startswith("test_")]
    for file in (*sorted(package.rglob("*.py")), *sorted(helpers)):
        found.update(file.read_bytes())
    for file in sorted((package / "data").rglob("*")):
        about = file.stat()
        found.update(f"{file} {about.st_size} {about.st_mtime_ns}".encode())
    return found.hexdigest()[:20]


@functools.cache
def _folder() -> Path:
    """The folder of these sources."""
    uid = os.getuid() if hasattr(os, "getuid") else 0
    place = Path(tempfile.gettempdir()) / f"poise-tests-{uid}"
    place.mkdir(mode=0o700, exist_ok=True)
    folder = place / _digest()
    folder.mkdir(exist_ok=True)
    os.utime(folder)
    for old in place.iterdir():
        if time.time() - old.stat().st_mtime > KEPT:
            shutil.rmtree(old, ignore_errors=True)
    return folder


def made_once(name: str, make: Callable[[Path], object]) -> Path:
    """The folder that `make(folder)` filled, here or in an earlier test: to be read, never written into.

    name: tells apart all that differs in what `make` does.
    """
    folder = _folder() / name
    if folder.exists():
        return folder
    with (_folder() / f"{name}.lock").open("w") as lock:
        if "fcntl" in globals():
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            part = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=_folder()))
            make(part)
            with suppress(OSError):
                part.rename(folder)
    return folder


def copied(name: str, make: Callable[[Path], object], to: Path) -> Path:
    """`made_once`, copied to `to`, which may be written into."""
    shutil.copytree(made_once(name, make), to, dirs_exist_ok=True)
    return to
