"""Learning curves of perpetual runs from their own files: success, help and error over samples."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from field.sources import by_source

from poise.errors import PoiseError
from poise.score.report.svg import line_plot

#: What a curve shows: its key, its title, its axis.
PANELS = (
    ("success", "Success of the stage's clips, with the help of that moment", "% of clips"),
    ("help", "Residual force that is left", "N"),
    ("error", "Global error of the stage's clips", "mm"),
)
#: Height of one panel, px; `score.report.svg` draws all plots in this size.
HIGH, WIDE = 300, 560


def read_curve(folder: Path) -> dict[str, Any]:
    """The evaluations in `log.csv`, one row each, and where each stage begins.

    Rows: samples, seconds, stage, clips, succeeded, error_mm, help_n, and by source of the clips how
    many succeeded of how many. "recoveries": samples, stage's name, trials, recovered. "stages": name,
    samples before it.

    Raises:
        PoiseError: no log, or one without an evaluation.
    """
    path = folder / "log.csv"
    if not path.exists():
        raise PoiseError("there is no log of the training", path, code="file-missing")
    with path.open(newline="", encoding="utf-8") as file:
        lines = [r for r in csv.DictReader(file) if None not in r.values()]
    told = _evaluated(folder)
    named, sources, rows, back = _stage_names(told), _sources(told), [], []
    stages, before = [], 0
    for line in lines:
        number = int(float(line["stage"]))
        name = named.get(int(float(line["iteration"])), "")
        if not stages or stages[-1][0] != number:
            stages.append([number, before])
        before = int(float(line["samples"]))
        if line.get("eval/trials"):
            tried, came = (int(float(line[f"eval/{k}"])) for k in ("trials", "recovered"))
            back.append({"samples": before, "stage": number, "trials": tried, "recovered": came})
        if not line.get("eval/clips"):
            continue
        rows.append({
            "samples": before, "seconds": round(float(line["time/seconds"]), 1), "stage": number,
            "name": name, "clips": int(float(line["eval/clips"])),
            "succeeded": int(float(line["eval/succeeded"])),
            "error_mm": round(float(line["eval/mpjpe_global_mm"]), 2),
            "help_n": round(float(line.get("env/help/limit_n") or 0.0), 2),
            "sources": sources.get(int(float(line["iteration"])), {}),
        })  # fmt: skip
    # A stage that learns recovery alone evaluates no clips.
    names = {r["stage"]: "recovery" for r in back}
    names |= {r["stage"]: r["name"] for r in rows if r["name"]}
    begun = [{"stage": names.get(n, f"stage {n}"), "from_samples": at} for n, at in stages]
    for row in (*rows, *back):
        row["name"] = names.get(row["stage"], f"stage {row['stage']}")
    return {"evaluations": rows, "recoveries": back, "stages": begun, "samples": before}


def _evaluated(folder: Path) -> list[dict[str, str]]:
    """The rows of `success.csv`, without those of the finished policy."""
    path = folder / "success.csv"
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [r for r in rows if r["iteration"].isdigit() and r.get("stage") not in (None, "final")]


def _stage_names(rows: Sequence[Mapping[str, str]]) -> dict[int, str]:
    """The stage's name at each iteration with an evaluation."""
    return {int(r["iteration"]): r["stage"] for r in rows}


def _sources(evaluated: Sequence[Mapping[str, str]]) -> dict[int, dict[str, tuple[int, int]]]:
    """At each iteration with an evaluation, by source: clips that succeed, clips."""
    found: dict[int, list[tuple[str, bool]]] = {}
    for r in evaluated:
        if r.get("succeeded"):
            found.setdefault(int(r["iteration"]), []).append((r["clip"], r["succeeded"] == "1"))
    return {
        at: {source: (sum(done), len(done)) for source, done in by_source(rows).items()}
        for at, rows in found.items()
    }


def draw(name: str, curve: Mapping[str, Any], path: Path) -> None:
    """One image of three panels, one colour per stage, a bar where each begins; where there are several
    sources of clips, a panel of success with one colour per source."""
    plots = []
    for key, title, unit in PANELS:
        series, top = [], 0.0
        for stage in curve["stages"]:
            own = [r for r in curve["evaluations"] if r["name"] == stage["stage"]]
            values = [_value(r, key) for r in own]
            top = max([top, *(v for v in values if math.isfinite(v))])
            series.append((stage["stage"], [r["samples"] for r in own], values))
        # A stage begins with an upright stroke at the samples before it.
        for k, stage in enumerate(curve["stages"]):
            if k:
                at = float(stage["from_samples"])
                label, x, y = series[k]
                series[k] = (label, [at, at, math.nan, *x], [0.0, top, math.nan, *y])
        if key == "success" and curve["recoveries"]:
            shares = [100.0 * r["recovered"] / r["trials"] for r in curve["recoveries"]]
            series.append(("back from falls", [r["samples"] for r in curve["recoveries"]], shares))
        plots.append(line_plot(series, f"{name}: {title}", "samples", unit, zero=True))
    sources = list(dict.fromkeys(s for r in curve["evaluations"] for s in r.get("sources", ())))
    if len(sources) > 1:
        title = f"{name}: success by source of the clips"
        plots.append(line_plot(_by_source(curve, sources), title, "samples", "% of clips", zero=True))
    _stack(plots, path)


def _by_source(
    curve: Mapping[str, Any], sources: Sequence[str]
) -> list[tuple[str, list[float], list[float]]]:
    """A curve of success in % for each source, over the evaluations that hold clips of it."""
    series = []
    for source in sources:
        own = [r for r in curve["evaluations"] if source in r.get("sources", ())]
        shares = [100.0 * r["sources"][source][0] / r["sources"][source][1] for r in own]
        series.append((source, [float(r["samples"]) for r in own], shares))
    return series


def draw_runs(curves: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """The same panels with one colour per run."""
    plots = []
    for key, title, unit in PANELS:
        series = [
            (name, [r["samples"] for r in c["evaluations"]], [_value(r, key) for r in c["evaluations"]])
            for name, c in curves.items()
        ]
        plots.append(line_plot(series, title, "samples", unit, zero=True))
    _stack(plots, path)


def _value(row: Mapping[str, Any], key: str) -> float:
    if key == "success":
        return 100.0 * row["succeeded"] / row["clips"]
    return float(row["help_n"] if key == "help" else row["error_mm"])


def _stack(plots: Sequence[str], path: Path) -> None:
    """Plots of one size below each other as one file."""
    parts = [re.sub(r"<svg ", f'<svg y="{k * HIGH}" ', plot, count=1) for k, plot in enumerate(plots)]
    high = HIGH * len(plots)
    text = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDE} {high}" width="{WIDE}" '
        f'height="{high}">' + "".join(parts) + "</svg>"
    )
    path.write_text(text, encoding="utf-8")


def at_samples(curve: Mapping[str, Any], samples: int, clips: int) -> dict[str, Any] | None:
    """The latest evaluation of all `clips` at or before so many samples; None if there was none."""
    rows = [r for r in curve["evaluations"] if r["samples"] <= samples and r["clips"] == clips]
    return rows[-1] if rows else None
