"""Numbers in text: each with the place of every mistake, and blank cells that mean something missing."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.motion.io.text import MAX_VALUE, at_line, shown

BLANK = b" \t,;"
"""Lines of these alone are passed over."""
MISSING = {"", "nan", "-nan", "nan(ind)", "-nan(ind)", "na", "n/a", "null", "none"}
"""Cells in lower case that stand for a missing value."""


def number(token: str | bytes, where: str) -> float:
    """One finite number; anything else is refused with its place."""
    try:
        if ("_" if isinstance(token, str) else b"_") in token:  # type: ignore[operator]
            raise ValueError
        value = float(token)
    except ValueError:
        raise PoiseError(f"{shown(token)} is not a number", where) from None
    if not abs(value) <= MAX_VALUE:
        raise PoiseError(f"{shown(token)} is not a usable number", where)
    return value


def append_numbers(values: array[float], tokens: list[bytes], where: str) -> None:
    """Adds the numbers of one row in one go; on a mistake, names the token at fault.

    NaN and inf pass, so that the caller can name the joint and frame.
    """
    size = len(values)
    try:
        # Python reads "1_000" as a number; motion files do not.
        if b"_" in b"".join(tokens):
            raise ValueError
        values.extend(map(float, tokens))
    except ValueError:
        del values[size:]
        for token in tokens:
            try:
                float(token.replace(b"_", b"x"))
            except ValueError:
                raise PoiseError(f"{shown(token)} is not a number", where) from None


def first_bad(table: np.ndarray) -> tuple[int, int] | None:
    """(row, column) of the first value that is not finite or is absurdly large, else None."""
    bad = ~(np.abs(table) <= MAX_VALUE)
    if not bad.any():
        return None
    row, column = np.argwhere(bad)[0]
    return int(row), int(column)


def number_table(
    lines: list[bytes], first: int, width: int, path: Path, mark: bytes | None = None
) -> np.ndarray:
    """`(T, width)` the numbers in the lines from index `first` on; blank lines are passed over.

    mark: what stands between the numbers, None for blanks.

    Raises:
        PoiseError: a row of another width, or a word that is no number, with the line.
    """
    values: array[float] = array("d")
    for i in range(first, len(lines)):
        if not lines[i].strip(BLANK if mark else None):
            continue
        tokens = lines[i].split(mark)
        if len(tokens) != width:
            what = f"the row has {len(tokens)} values; there are {width} columns"
            raise PoiseError(what, at_line(path, i + 1))
        append_numbers(values, tokens, at_line(path, i + 1))
    return np.frombuffer(values, dtype=np.float64).reshape(-1, width)


def row_numbers(cells: list[str], column: Callable[[int], str], path: Path, line: int) -> list[float]:
    """The numbers of one row, NaN where a cell is blank or says so.

    column: the name of a column by its index, for the place of a mistake ("line 7, column 4 (RHip Y)").
    """
    try:
        # Python reads "1_000" as a number; tables do not.
        if "_" not in "".join(cells):
            values = [float(c) if c and not c.isspace() else np.nan for c in cells]
            if all(abs(v) <= MAX_VALUE or v != v for v in values):
                return values
    except ValueError:
        pass
    out = []
    for k, cell in enumerate(cells):
        text = cell.strip()
        if text.lower() in MISSING:
            out.append(np.nan)
        else:
            if text.count(",") == 1 and "." not in text:
                # A decimal comma: no table here separates its cells by commas and holds one in a cell.
                text = text.replace(",", ".")
            out.append(number(text, f"{at_line(path, line)}, column {k + 1} ({column(k)})"))
    return out
