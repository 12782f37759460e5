"""Run as a script in a process of its own: a parser in native code, under limits of memory and time.

It imports nothing of Poise, so that it starts at once. What it reads goes to the standard output as an
npz, what it refuses as JSON; see `limited`, which starts it.
"""

from __future__ import annotations

import io
import json
import os
import runpy
import sys
from typing import NoReturn

import numpy as np

#: Exit codes: refused in a sentence, out of memory, any other exception.
REFUSED, MEMORY, FAULT = 3, 4, 5


class _RefusedError(Exception):
    """What a job refuses: what was wrong, what to do, the code of it."""


def refuse(what: str, hint: str | None = None, code: str = "file-damaged") -> NoReturn:
    """Ends a job with one sentence."""
    raise _RefusedError(what, hint, code)


def limit(seconds: float, memory: int) -> None:
    """Limits of processor time and memory, as far as the platform has them."""
    try:
        import resource
    except ImportError:
        return
    whole = int(seconds) + 1
    # Address space holds what is only reserved, too, so that it needs more room.
    for name, value in (("RLIMIT_CPU", whole), ("RLIMIT_DATA", memory), ("RLIMIT_AS", 4 * memory)):
        if (kind := getattr(resource, name, None)) is None:
            continue
        try:
            _, most = resource.getrlimit(kind)
            value = value if most == resource.RLIM_INFINITY else min(value, most)
            resource.setrlimit(kind, (value, most))
        except (ValueError, OSError):
            continue


def main(script: str, path: str, seconds: str, memory: str, options: str) -> int:
    """Runs `read(path, refuse, **options)` of a script; the exit code."""
    # Libraries may print; only the answer belongs into the pipe.
    pipe = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    limit(float(seconds), int(memory))
    answer: dict[str, str | None]
    try:
        arrays = runpy.run_path(script)["read"](path, refuse, **json.loads(options))
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        pipe.write(buffer.getbuffer())
        pipe.flush()
        return 0
    except _RefusedError as error:
        (what, hint, kind), code = error.args, REFUSED
        answer = {"what": what, "hint": hint, "code": kind}
    except MemoryError:
        answer, code = {}, MEMORY
    except BaseException as error:
        answer, code = {"what": str(error), "hint": None}, FAULT
    pipe.write(json.dumps(answer).encode())
    pipe.flush()
    return code


if __name__ == "__main__":
    ended = main(*sys.argv[1:])
    # Native libraries may crash in their own farewell, when all is said.
    os._exit(ended)
