"""Rows of `results/SUITE.csv`: written beside those that are there, each figure once."""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

from poise.learn.checkpoint import write_atomic


class Figure(NamedTuple):
    """A row of a table of results.

    Attributes:
        spread: of the value, as text; "" for none. n: how many were measured. seeds: how many draws.
        policy: other than the part's, such as "full (trained for this table)".
    """

    subject: str
    metric: str
    value: float
    n: int
    spread: str = ""
    seeds: int = 1
    policy: str | None = None


@dataclass(frozen=True)
class Row:
    """A line of the table, all as text."""

    subject: str
    metric: str
    value: str
    spread: str
    n: str
    seeds: str
    policy: str
    commit: str
    command: str
    core_hours: str = ""
    machine: str = ""

    @property
    def key(self) -> tuple[str, str]:
        """A table has one row of each subject and metric."""
        return self.subject, self.metric


COLUMNS = tuple(f.name for f in fields(Row))


def short(value: float) -> str:
    """A number with four digits, whole ones whole."""
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else f"{value:.4g}"


def read(path: Path) -> list[Row]:
    """The rows of a table; none where there is no file. Columns that an older one lacks are empty."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as text:
        return [
            Row(**{k: v or "" for k, v in row.items() if k in COLUMNS}) for row in csv.DictReader(text)
        ]


def merge(path: Path, new: Iterable[Row], command: str = "") -> None:
    """Writes rows where those of the same figures stand, else in the end; whole or not at all.

    command: rows that it made before and that it makes no more go.
    """
    fresh = {row.key: row for row in new}
    out = list[Row]()
    for row in read(path):
        if row.key in fresh:
            out.append(fresh.pop(row.key))
        elif not command or row.command != command:
            out.append(row)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([getattr(row, name) for name in COLUMNS] for row in [*out, *fresh.values()])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, text.getvalue().encode())


def of(subject: str, values: dict[str, float | None], n: int, **more: object) -> list[Figure]:
    """Figures of one subject; what could not be measured is left out."""
    told = {k: float(v) for k, v in values.items() if v is not None and math.isfinite(v)}
    return [Figure(subject, k, v, n, **more) for k, v in told.items()]  # type: ignore[arg-type]


def mean_of(values: Iterable[float | None]) -> float:
    """The mean of what was measured; NaN without any."""
    told = [v for v in values if v is not None and math.isfinite(v)]
    return statistics.fmean(told) if told else math.nan


def median_of(values: Iterable[float | None]) -> float:
    """The median of what was measured; NaN without any."""
    told = [v for v in values if v is not None and math.isfinite(v)]
    return statistics.median(told) if told else math.nan


def between(values: Sequence[float]) -> str:
    """The spread of draws: "0.94 to 0.97"; "" for fewer than two."""
    return f"{short(min(values))} to {short(max(values))}" if len(values) > 1 else ""
