"""One writer a run folder: two trainings in one would write over each other's checkpoints."""

from __future__ import annotations

import functools
import importlib
import os
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from poise.errors import PoiseError

#: Seconds in which the processes of a training that was killed just now may end.
PATIENCE_S = 3.0
_POLL_S = 0.1
P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")


@contextmanager
def only_writer(folder: Path) -> Generator[None]:
    """Holds a folder as its only writer; the system lets go of it however the process ends.

    Where folders cannot be locked (Windows, some network disks) nothing is held.

    Raises:
        PoiseError: another process holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if os.name != "posix":
        yield
        return
    fcntl: Any = importlib.import_module("fcntl")
    held = os.open(folder, os.O_RDONLY)
    end = time.monotonic() + PATIENCE_S
    try:
        while True:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > end:
                    hint = "Wait until it ends, or choose another folder"
                    raise PoiseError("another training writes here", folder, hint) from None
                time.sleep(_POLL_S)
            except OSError:
                break
        yield
    finally:
        os.close(held)


def alone(train: Callable[Concatenate[T, Path, P], R]) -> Callable[Concatenate[T, Path, P], R]:
    """A training that takes its folder as second argument, as that folder's only writer."""

    @functools.wraps(train)
    def held(what: T, folder: Path, *args: P.args, **kwargs: P.kwargs) -> R:
        with only_writer(folder):
            return train(what, folder, *args, **kwargs)

    return held
