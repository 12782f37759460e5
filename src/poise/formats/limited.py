"""Parsers in native code, in a process of their own: a crash or a hang of theirs is one sentence."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.apart import FAULT, MEMORY, REFUSED
from poise.formats.text import CUT_OFF, shown

#: Memory and processor time that a parser may take: of its own, and for each byte of the file.
BYTES, BYTES_EACH = 1 << 30, 16
SECONDS, SECONDS_EACH = 20.0, 2e-6
#: A busy machine may need so many times longer.
_PATIENCE = 8.0
_SCRIPT = Path(__file__).with_name("apart.py")
#: Variables of that process: libraries that work in threads reserve memory for each of them.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "PXR_WORK_THREAD_LIMIT"), "1"
)


def read_limited(
    script: Path, path: Path, size: int, kind: str, hint: str | None = CUT_OFF, **options: Any
) -> dict[str, np.ndarray]:
    """What `read(path, refuse, **options)` of a script says of a file, as named arrays.

    The script is run alone: it may import its library and NumPy, nothing of Poise.

    Args:
        size: bytes of the file, by which memory and time are limited.
        kind: how a sentence calls the file ("C3D file"). hint: what to do where it is damaged.

    Raises:
        PoiseError: what the script refused; the library failed, crashed or went beyond a limit.
    """
    seconds, memory = SECONDS + size * SECONDS_EACH, BYTES + size * BYTES_EACH
    # -P: a module that lies beside the user's files is never imported.
    command = [sys.executable, "-P", str(_SCRIPT), str(script), str(path.resolve())]
    command += [str(seconds), str(memory), json.dumps(options)]
    slow = PoiseError(
        f"the {kind} could not be read in {seconds:.0f} s",
        path,
        "It seems damaged",
        code="reading-too-slow",
    )
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            timeout=_PATIENCE * seconds, check=False, env={**os.environ, **ONE_THREAD},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise slow from None
    except OSError as error:
        raise PoiseError(
            f"no process could be started to read it ({error.strerror})", path, code="no-process"
        ) from None
    if done.returncode == 0:
        try:
            with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
                return dict(arrays)
        except (ValueError, OSError, EOFError, zipfile.BadZipFile):
            said = {}
    if done.returncode == -getattr(signal, "SIGXCPU", 24):
        raise slow
    if done.returncode == MEMORY:
        raise PoiseError(
            f"the {kind} takes more than {memory / 1e9:.1f} GB to read", path, hint, code="out-of-memory"
        )
    said = _said(done.stdout) if done.returncode in (REFUSED, FAULT) else {}
    if done.returncode == REFUSED and said:
        raise PoiseError(
            str(said.get("what")), path, said.get("hint"), code=str(said.get("code") or "file-damaged")
        )
    crashed = "what reads it crashed" if done.returncode < 0 else f"reading ended with {done.returncode}"
    reason = shown(what) if (what := " ".join(str(said.get("what") or "").split())) else crashed
    raise PoiseError(f"the {kind} is damaged ({reason})", path, hint, code="file-damaged")


def _said(answer: bytes) -> dict[str, Any]:
    try:
        said = json.loads(answer)
    except ValueError:
        return {}
    return said if isinstance(said, dict) else {}
