"""Parsers in native code without the start of a process for each file: the worker forks.

`poise.formats.limited` starts Python and imports a library for every file, some 200 ms. Here the
process that fuzzes has the library already, and a child of it runs the same script (`apart`) under the
same limits, its answer and its end taken in the same way: 20 to 60 ms.
"""

from __future__ import annotations

import os
import select
import subprocess
import time
from collections.abc import Iterable
from importlib import import_module
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

from poise.formats import apart, limited

#: The libraries of formats.
LIBRARIES = {
    "usda": ("pxr.Usd", "pxr.UsdGeom", "pxr.UsdSkel"), "usdc": ("pxr.Usd", "pxr.UsdGeom", "pxr.UsdSkel"),
    "c3d": ("ezc3d",), "fbx": ("ufbx",), "mjcf": ("mujoco",),
}  # fmt: skip


def fork_instead(formats: Iterable[str]) -> None:
    """Makes this process fork wherever `limited` would start one."""
    os.environ.update(limited.ONE_THREAD)
    for name in sorted({x for kind in formats for x in LIBRARIES.get(kind, ())}):
        if find_spec(name.partition(".")[0]) is not None:
            import_module(name)
    limited.subprocess = SimpleNamespace(  # type: ignore[assignment]
        run=run, PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL,
        TimeoutExpired=subprocess.TimeoutExpired,
    )  # fmt: skip


def run(command: list[str], *, timeout: float, **_: Any) -> subprocess.CompletedProcess[bytes]:
    """What `subprocess.run` returns of `python -P apart.py SCRIPT PATH SECONDS MEMORY OPTIONS`."""
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.dup2(theirs, 1)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            code = apart.main(*command[3:])
        finally:
            os._exit(code)
    os.close(theirs)
    parts, end = list[bytes](), time.monotonic() + timeout
    try:
        while select.select([ours], [], [], max(0.0, end - time.monotonic()))[0]:
            if not (part := os.read(ours, 1 << 20)):
                break
            parts.append(part)
        else:
            os.kill(child, 9)
            raise subprocess.TimeoutExpired(command, timeout)
    finally:
        os.close(ours)
        status = os.waitpid(child, 0)[1]
    return subprocess.CompletedProcess(command, os.waitstatus_to_exitcode(status), b"".join(parts))
