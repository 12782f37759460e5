"""What a verb came to: exit code, files, and the one JSON document of `--json` (docs/cli.md)."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from poise import __version__
from poise.errors import PoiseError

#: Exit codes beside 0 (done) and 1 (a fault of Poise or of the machine).
REFUSED, LOST, INTERRUPTED = 2, 3, 130
#: Options that name what a verb reads.
_INPUTS = ("clip", "clips", "source", "run", "library", "onto", "seed_clip")
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass
class Answer:
    """What a verb returns. Its tables and sentences are printed already; notes and outputs are not.

    Attributes:
        result: the verb's own figures, as JSON data.
        outputs: what was written, by name.
        notes: sentences on the input and on what was done to it.
        exit_code: 0, or `LOST` and the like.
        outcome: a few words for the table of a folder, such as "tracked".
        error_mm: the tracking error for that table, None where nothing is tracked.
        said: those of the notes that were told already, while the verb ran.
    """

    result: Any = None
    outputs: Mapping[str, Path] = field(default_factory=dict)
    notes: Sequence[str] = ()
    exit_code: int = 0
    outcome: str = ""
    error_mm: float | None = None
    said: Sequence[str] = ()


def inputs_of(options: Any) -> list[Path]:
    """The files and folders that the options of a verb name as its input."""
    found: list[Path] = []
    for name in _INPUTS:
        value = getattr(options, name, None)
        # `train` holds its library in a group of options of that name.
        value = getattr(value, "library", value)
        found += value if isinstance(value, tuple) else [value] if value is not None else []
    return found


def document(
    verb: str, inputs: Sequence[Path], answer: Answer, error: PoiseError | None
) -> dict[str, Any]:
    """The document of `--json`, the same for every verb; numbers that are not finite become null."""
    from poise.settings import plain

    told = None if error is None else {"what": error.what, "where": error.where, "hint": error.hint}
    return plain(
        {
            "poise": __version__,
            "verb": verb,
            "ok": answer.exit_code == 0,
            "exit_code": answer.exit_code,
            "inputs": inputs,
            "outputs": answer.outputs,
            "notes": answer.notes,
            "result": answer.result,
            "error": told,
        }
    )


def failure(problem: BaseException) -> tuple[int, PoiseError]:
    """The exit code of a failure, and the failure in one sentence."""
    if isinstance(problem, PoiseError):
        return REFUSED, problem
    if isinstance(problem, KeyboardInterrupt):
        return INTERRUPTED, PoiseError("interrupted")
    if isinstance(problem, OSError) and (problem.filename is not None or problem.errno in _DISK):
        return REFUSED, of_path(problem)
    if isinstance(problem, MemoryError):
        return 1, PoiseError("there is not enough memory; use fewer --envs or a shorter clip")
    said = f": {problem}" if str(problem) else ""
    hint = "This is a fault of Poise; set POISE_DEBUG=1 and run again for the traceback"
    return 1, PoiseError(f"unexpected {type(problem).__name__}{said}", hint=hint)


def of_path(problem: OSError) -> PoiseError:
    """A failed access to a path of the user's, in one sentence."""
    reason = (problem.strerror or os.strerror(problem.errno or 0)).lower()
    hint = "Free some space" if problem.errno in _DISK[:2] else "Choose a path that can be used"
    return PoiseError(f"cannot be read or written ({reason})", problem.filename or "the disk", hint)
