"""Everything that is printed, and what a verb came to: exit code, files, the JSON of `--json`."""

from __future__ import annotations

import errno
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from poise import __version__
from poise.errors import PoiseError, printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from poise.score import ScoreCard


#: Variables by which users ask for colours where no terminal is seen.
_COLOURS = ("FORCE_COLOR", "TTY_COMPATIBLE")
#: Columns of a table that goes to a file or a pipe, where no window limits it.
_PIPE_WIDTH = 120


def _console(stream: Any, everywhere: bool = False) -> Console:
    from rich.console import Console

    # Made anew for each use, so that a stream that was replaced (by a test, a notebook) is honoured.
    terminal = hasattr(stream, "isatty") and stream.isatty()
    return Console(
        file=stream,
        highlight=False,
        markup=False,
        emoji=False,
        width=None if terminal else _PIPE_WIDTH,
        quiet=rank() > 0 and not everywhere,
    )


def launched() -> bool:
    """Whether `torchrun` started this process."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def rank() -> int:
    """This process's number among those that `torchrun` started, of which only 0 speaks; else 0."""
    return int(os.environ["RANK"]) if launched() else 0


def _line(stream: Any, text: str, style: str = "", head: str = "", everywhere: bool = False) -> None:
    """One line, never wrapped; `head` in red before it.

    A pipe or a file gets the text alone, without rich, which takes as long to import as a short file
    takes to be read.
    """
    styled = any(os.environ.get(name) for name in _COLOURS)
    if styled or (hasattr(stream, "isatty") and stream.isatty()):
        from rich.text import Text

        line = Text.assemble((head, "bold red"), (text, style))
        _console(stream, everywhere).print(line, soft_wrap=True)
    elif rank() == 0 or everywhere:
        stream.write(head + text.expandtabs() + "\n")


def _unread(stream: Any) -> bool:
    """Whether nobody reads what is printed, as beside `--json`."""
    return getattr(stream, "name", None) == os.devnull


def out() -> Console:
    """The console of results."""
    return _console(sys.stdout)


def err() -> Console:
    """The console of errors and progress."""
    return _console(sys.stderr)


def say(text: str, style: str = "") -> None:
    """One line of result; it is never wrapped, so that paths can be copied."""
    _line(sys.stdout, printable(text, "\n\t"), style)


def tell(text: str, style: str = "") -> None:
    """One line beside the results, on stderr."""
    _line(sys.stderr, printable(text, "\n\t"), style)


def error(sentence: str, everywhere: bool = False) -> None:
    """Exactly one line `error: ...` on stderr, whatever the sentence holds.

    everywhere: of several processes also those speak that are silent otherwise.
    """
    line = printable(" ".join(sentence.split()))
    if rank():
        line = f"process {rank()}: {line}"
    _line(sys.stderr, line, head="error: ", everywhere=everywhere)


def say_json(value: Any) -> None:
    """JSON alone on stdout, to be read by a program."""
    if rank():
        return
    sys.stdout.write(json.dumps(value, indent=2, allow_nan=False) + "\n")


def notes(sentences: Sequence[str], limit: int = 12) -> None:
    """Sentences as a list, the first `limit` of them."""
    for sentence in sentences[:limit]:
        say(f"  - {sentence}", "dim")
    if len(sentences) > limit:
        say(f"  - and {len(sentences) - limit} more", "dim")


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], left: int = 1) -> None:
    """A table: its first `left` columns are words, the others are figures."""
    if _unread(sys.stdout):
        return
    from rich.table import Table
    from rich.text import Text

    if title:
        # As a line of its own, since rich would fold a title to the width of its table.
        say(title, "bold")
    grid = Table(header_style="bold", show_header=any(columns))
    for k, name in enumerate(columns):
        grid.add_column(Text(name), justify="left" if k < left else "right", overflow="fold")
    for row in rows:
        grid.add_row(*(c if isinstance(c, Text) else Text(printable(str(c), "\n")) for c in row))
    out().print(grid)


_STYLES = {"good": "green", "fair": "yellow", "poor": "red"}


def print_card(card: ScoreCard) -> None:
    """The score card with its verdicts, then the one sentence that sums it up."""
    from poise.score import table as rows_of
    from poise.score.report.verdict import sentence

    rows = [
        (label, "-" if math.isnan(value) else f"{value:,.4g}", unit, _verdict(verdict))
        for label, value, unit, verdict in rows_of(card)
    ]
    episodes = "1 episode" if card.episodes == 1 else f"{card.episodes} episodes"
    until = " until it was lost" if card.cut else ""
    title = f"{card.clip or 'run'}: {episodes}, {card.frames:,} frames{until}"
    table(title, ("", "value", "unit", "verdict"), rows)
    say(sentence(card.to_dict()))


def _verdict(word: str) -> Text:
    from rich.text import Text

    return Text(word, style=_STYLES.get(word, ""))


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
        value = options.get(name) if isinstance(options, Mapping) else getattr(options, name, None)
        # `train` holds its library in a group of options of that name.
        value = getattr(value, "library", value)
        found += value if isinstance(value, tuple) else [value] if value is not None else []
    return found


def document(
    verb: str, inputs: Sequence[Path], answer: Answer, error: PoiseError | None
) -> dict[str, Any]:
    """The document of `--json`, the same for every verb; numbers that are not finite become null."""
    from poise.settings import plain

    told = None
    if error is not None:
        told = {"code": error.code, "what": error.what, "where": error.where, "hint": error.hint}
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
        return INTERRUPTED, PoiseError("interrupted", code="interrupted")
    if isinstance(problem, OSError) and (problem.filename is not None or problem.errno in _DISK):
        return REFUSED, of_path(problem)
    if isinstance(problem, MemoryError):
        return 1, PoiseError(
            "there is not enough memory; use fewer --envs or a shorter clip", code="out-of-memory"
        )
    if isinstance(problem, ImportError) and (package := _absent(problem)):
        return REFUSED, PoiseError(
            f"this needs the package {package}, which is not installed",
            hint=f"pip install {package}. Files are read, mended, converted and retargeted without it",
            code="package-missing",
        )
    said = f": {problem}" if str(problem) else ""
    hint = "This is a fault of Poise; set POISE_DEBUG=1 and run again for the traceback"
    return 1, PoiseError(f"unexpected {type(problem).__name__}{said}", hint=hint, code="internal-fault")


#: Packages that verbs need which simulate or learn, by the module's name.
_HEAVY = {
    "torch": "torch",
    "mujoco": "mujoco",
    "gymnasium": "gymnasium",
    "safetensors": "safetensors",
    "tensorboard": "tensorboard",
}


def _absent(problem: ImportError) -> str | None:
    """The package that an import did not find, if it is one of those that files need not."""
    return _HEAVY.get((problem.name or "").partition(".")[0])


def of_path(problem: OSError) -> PoiseError:
    """A failed access to a path of the user's, in one sentence."""
    reason = (problem.strerror or os.strerror(problem.errno or 0)).lower()
    hint = "Free some space" if problem.errno in _DISK[:2] else "Choose a path that can be used"
    return PoiseError(
        f"cannot be read or written ({reason})",
        problem.filename or "the disk",
        hint,
        code="path-unusable",
    )
