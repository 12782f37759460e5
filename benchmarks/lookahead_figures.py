"""Figures of rows that `lookahead.py` wrote: shares, medians and means of their episodes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]
#: What a row is known by.
KEY = ("set", "clip", "controller", "budget", "condition", "starts")
#: mm/s that feet may slide whatever their source does, and the share of its stance that must stay.
CLEAN, STANCE = 40.0, 0.9


def named(row: Row) -> str:
    """The controller with its budget."""
    return f"{row['controller']} {row['budget']}".strip()


def groups(rows: Iterable[Row], *by: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows gathered by some of their keys, in the order in which these come."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[k] for k in by), []).append(row)
    return found


def ordered(rows: Iterable[Row]) -> list[Row]:
    """By controller and budget: nothing, the policy, lookahead with less to more."""
    order = ("nothing", "policy", "lookahead")

    def steps(row: Row) -> int:
        copies, _, far = row["budget"].partition("x")
        return int(copies) * int(far) if far else 0

    return sorted(rows, key=lambda r: (order.index(r["controller"]), steps(r)))


def episodes(rows: Iterable[Row], whole: bool = False) -> list[Row]:
    """All episodes of the rows, or those that were done whole."""
    return [e for r in rows for e in r["episodes"] if e["whole"] or not whole]


def success(rows: Sequence[Row], key: str = "whole") -> tuple[float, float]:
    """Share of the episodes, and its standard deviation over starts (NaN for one)."""
    starts = sorted({e["start"] for e in episodes(rows)})
    each = [statistics.fmean(e[key] for e in episodes(rows) if e["start"] == k) for k in starts]
    return statistics.fmean(each), statistics.stdev(each) if len(each) > 1 else math.nan


def median(rows: Sequence[Row], of: str | Callable[[Row], float | None]) -> float:
    """Over the episodes that were done whole; NaN without any."""
    values = [e[of] if isinstance(of, str) else of(e) for e in episodes(rows, whole=True)]
    return _or_nan(statistics.median, values)


def mean(rows: Sequence[Row], key: str) -> float:
    """Over all episodes."""
    return _or_nan(statistics.fmean, [e.get(key) for e in episodes(rows)])


def _or_nan(how: Callable[[list[float]], float], values: Iterable[float | None]) -> float:
    told = [v for v in values if v is not None]
    return how(told) if told else math.nan


def jerk_ratio(e: Row) -> float | None:
    """Jerk beside the source's."""
    return e["jerk"] / e["source_jerk"] if e["jerk"] is not None and e["source_jerk"] else None


def slides_as_source(e: Row) -> float | None:
    """Whether feet slide no more than the source's, or than `CLEAN`."""
    if e["slide"] is None or e["source_slide"] is None:
        return None
    return float(e["slide"] <= max(e["source_slide"], CLEAN))


def stands_as_source(e: Row) -> float | None:
    """Whether soles touch the ground for `STANCE` of the source's time or more."""
    return None if e["stance_ratio"] is None else float(e["stance_ratio"] >= STANCE)


def share(rows: Sequence[Row], of: Callable[[Row], float | None]) -> float:
    """Of the episodes that were done whole."""
    return _or_nan(statistics.fmean, [of(e) for e in episodes(rows, whole=True)])


def decision(rows: Sequence[Row]) -> tuple[float, float]:
    """Median and 99th percentile of all decisions, ms."""
    times = sorted(t for r in rows for t in r.get("decision_ms", ()))
    if not times:
        return math.nan, math.nan
    return times[len(times) // 2], times[int(0.99 * (len(times) - 1))]


def budget(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """(controller, rows) of the policy and of all budgets, of the clips that were tried with all."""
    plain = [r for r in ordered(rows) if r["condition"] == "none" and r["controller"] != "nothing"]
    tried = groups(plain, "controller", "budget", "starts")
    many = {starts for (_, b, starts) in tried if b}
    best: list[tuple[str, list[Row]]] = []
    for starts in many:
        of = {k: g for k, g in tried.items() if k[2] == starts}
        same = set.intersection(*({(r["set"], r["clip"]) for r in g} for g in of.values()))
        found = [(named(g[0]), [r for r in g if (r["set"], r["clip"]) in same]) for g in of.values()]
        best = found if len(found) > max(2, len(best)) and same else best
    return best


def steps(rows: Sequence[Row]) -> float:
    """Simulated control steps for each that was made; 0 for the policy alone."""
    return statistics.fmean(r.get("steps_per_step", 0.0) for r in rows)
