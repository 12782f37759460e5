"""Rows of numbers in which blank cells mean that something is missing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from poise.motion.io.text import MAX_VALUE, at_line, number

MISSING = {"", "nan", "-nan", "nan(ind)", "-nan(ind)", "na", "n/a", "null", "none"}
"""Cells in lower case that stand for a missing value."""


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
            out.append(number(text, f"{at_line(path, line)}, column {k + 1} ({column(k)})"))
    return out
