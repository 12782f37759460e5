"""Everything that is printed: results on stdout, errors and progress on stderr."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from poise.errors import printable

if TYPE_CHECKING:
    from poise.eval import ScoreCard


#: Columns of a table that goes to a file or a pipe, where no window limits it.
_PIPE_WIDTH = 120


def _console(stream: Any, everywhere: bool = False) -> Console:
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


def out() -> Console:
    """The console of results."""
    return _console(sys.stdout)


def err() -> Console:
    """The console of errors and progress."""
    return _console(sys.stderr)


def say(text: str, style: str = "") -> None:
    """One line of result; it is never wrapped, so that paths can be copied."""
    out().print(Text(printable(text, "\n\t"), style=style), soft_wrap=True)


def tell(text: str, style: str = "") -> None:
    """One line beside the results, on stderr."""
    err().print(Text(printable(text, "\n\t"), style=style), soft_wrap=True)


def error(sentence: str, everywhere: bool = False) -> None:
    """Exactly one line `error: ...` on stderr, whatever the sentence holds.

    everywhere: of several processes also those speak that are silent otherwise.
    """
    line = printable(" ".join(sentence.split()))
    if rank():
        line = f"process {rank()}: {line}"
    _console(sys.stderr, everywhere).print(Text.assemble(("error: ", "bold red"), line), soft_wrap=True)


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
    from poise.eval import table as rows_of
    from poise.view.verdict import sentence

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
    return Text(word, style=_STYLES.get(word, ""))
