"""Where clips come from, by their names: a table by source shows what a mean over a library hides."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import TypeVar

from field.card import FieldTable

T = TypeVar("T")
_SHOWN = ("g_mpjpe", "mpjpe", "acc", "vel")
#: Sources and what names of their clips hold, of which the first that fits counts.
SOURCES: tuple[tuple[str, str], ...] = (
    ("CMU, walks published for prediction", r"expmaps.*walking"),
    ("CMU, runs, jumps and ball games published for prediction", "expmaps"),
    ("DeepMimic", "deepmimic|humanoid3d"),
    ("Bandai", "bandai|^dataset[-_]"),
    ("CMU, dances", "salsa|indian|dance|-05_"),
    ("CMU, martial arts", "martial|kick|heiansyodan"),
    ("CMU, other", ""),
)


def source_of(name: str) -> str:
    """The source of a clip of that name."""
    return next(source for source, pattern in SOURCES if re.search(pattern, name))


def by_source(rows: Iterable[tuple[str, T]]) -> dict[str, list[T]]:
    """Rows with the names of their clips, gathered by source, in the order of `SOURCES`."""
    found: dict[str, list[T]] = {source: [] for source, _ in SOURCES}
    for name, row in rows:
        found[source_of(name)].append(row)
    return {source: own for source, own in found.items() if own}


def source_table(tables: Sequence[FieldTable]) -> str:
    """Clips, success and errors (by clip) of each source as Markdown."""
    lines = ["| method | data | source | clips | Succ % | g-MPJPE | MPJPE | acc | vel |"]
    lines.append("| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for t in tables:
        for source, clips in by_source((c.clip, c) for c in t.clips).items():
            done = sum(not c.failed for c in clips) / len(clips)
            means = (_mean(getattr(c.errors, k) for c in clips) for k in _SHOWN)
            figures = (f"{100 * done:.1f}", *means)
            cells = (t.method, t.data, source, str(len(clips)), *figures)
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _mean(values: Iterable[float]) -> str:
    told = [v for v in values if not math.isnan(v)]
    return f"{sum(told) / len(told):.1f}" if told else "-"
