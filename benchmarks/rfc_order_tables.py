"""What `rfc_order.py` writes of its runs: JSON, tables, a figure with a panel for each clip."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from poise.score.report import line_plot

Runs = dict[str, dict[str, Any]]

TITLES = {
    "nothing": "does nothing, no help",
    "deepmimic": "DeepMimic (no help)",
    "rfc-implicit": "RFC-Implicit",
    "rfc-explicit": "RFC-Explicit, hip and feet",
    "rfc-explicit-all": "RFC-Explicit, all bodies",
    "rfc-implicit-uncapped": "RFC-Implicit, uncapped",
    "rfc-explicit-uncapped": "RFC-Explicit, hip and feet, uncapped",
}
MAIN = ("deepmimic", "rfc-implicit", "rfc-explicit")
#: What is compared: key, name, decimals.
MEASURES = (
    ("eval_imitation", "imitation reward a step", 2),
    ("return_last", "return per episode", 1),
    ("succ", "share of start frames tracked to the end", 2),
)
#: Pairs whose order the paper states: the first above the second.
CLAIMS = (
    ("rfc-implicit", "deepmimic"),
    ("rfc-explicit", "deepmimic"),
    ("rfc-implicit", "rfc-explicit"),
    ("rfc-explicit-all", "rfc-explicit"),
    ("rfc-implicit-uncapped", "rfc-implicit"),
    ("rfc-explicit-uncapped", "rfc-explicit"),
)
RULE = (
    "Seeds of a clip are averaged. A difference is shown where its mean over the clips that both have "
    "is more than twice its standard error over these clips and, where clips have two seeds, more than "
    "twice their mean spread; with fewer than four clips nothing is shown."
)


def cells(runs: Runs, key: str, gains: bool = False) -> dict[str, dict[str, list[float]]]:
    """method -> clip -> the seeds' values."""
    out: dict[str, dict[str, list[float]]] = {}
    scaled = {n.split("/")[0] for n in runs if n.count("/") == 3}
    for name, run in runs.items():
        clip, method, _, *more = name.split("/")
        if key in run and (clip in scaled if gains else not more):
            # Scaled gains are columns of their own: one clip at each factor.
            at = f"{clip}, {more[0] if more else 'gains x 1'}" if gains else clip
            out.setdefault(method, {}).setdefault(at, []).append(float(run[key]))
    return {m: dict(sorted(out[m].items())) for m in TITLES if m in out}


def comparisons(runs: Runs) -> list[dict[str, Any]]:
    """Each claim by each measure, and whether it is shown by `RULE`."""
    out: list[dict[str, Any]] = []
    for key, *_ in MEASURES:
        table = cells(runs, key)
        spreads = [max(v) - min(v) for c in table.values() for v in c.values() if len(v) > 1]
        spread = float(np.mean(spreads)) if spreads else None
        for above, below in CLAIMS:
            both = sorted(set(table.get(above, {})) & set(table.get(below, {})))
            if not both:
                continue
            gap = np.array([np.mean(table[above][c]) - np.mean(table[below][c]) for c in both])
            mean, n = float(gap.mean()), len(gap)
            error = float(gap.std(ddof=1)) / math.sqrt(n) if n > 1 else None
            shown = n >= 4 and error is not None and mean > 2 * max(error, spread or 0.0)
            row = {"measure": key, "above": above, "below": below, "clips": n}
            row |= {"higher_on": int((gap > 0).sum()), "difference": _rounded(mean)}
            out.append(row | {"standard_error": _rounded(error), "seed_spread": _rounded(spread)})
            out[-1]["shown"] = shown
    return out


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _table(table: dict[str, dict[str, list[float]]], decimals: int) -> list[str]:
    """Rows of methods, columns of clips; the mean is of the columns that all trained methods have."""
    columns = sorted({c for row in table.values() for c in row})
    full = [c for c in columns if all(c in table[m] for m in MAIN if m in table)]
    lines = [f"| method | {' | '.join(columns)} | mean |", "|---" * (len(columns) + 2) + "|"]
    for method, row in table.items():
        shown = ["/".join(f"{v:.{decimals}f}" for v in row[c]) if c in row else "" for c in columns]
        whole = full and all(c in row for c in full)
        mean = f"{np.mean([np.mean(row[c]) for c in full]):.{decimals}f}" if whole else ""
        lines.append(f"| {TITLES[method]} | {' | '.join(shown)} | {mean} |")
    return lines


def markdown(command: str, runs: Runs, times: dict[str, Any] | None, stem: str) -> str:
    """All tables."""
    lines = [
        "# Residual forces against none", "", f"`{command}`", "",
        f"![Return per episode over samples, a panel for each clip]({stem}.svg)", "",
        "Seeds are divided by a slash; means are over the clips that the three main methods have.", "",
    ]  # fmt: skip
    for key, name, decimals in MEASURES:
        lines += [f"## {name.capitalize()}", "", *_table(cells(runs, key), decimals), ""]
    help_n = cells(runs, "force_mean_n")
    helped = {m: row for m, row in help_n.items() if m not in ("nothing", "deepmimic")}
    lines += ["## Mean force of the help, N", "", *_table(helped, 0), ""]
    lines += ["## Orders", "", RULE, "", "| measure | claim | higher on | difference | standard error | "
              "seed spread | |", "|---|---|---|---|---|---|---|"]  # fmt: skip
    for c in comparisons(runs):
        claim = f"{TITLES[c['above']]} above {TITLES[c['below']]}"
        numbers = ["-" if c[k] is None else f"{c[k]:.3f}" for k in ("standard_error", "seed_spread")]
        verdict = "shown" if c["shown"] else "not shown"
        clips = f"{c['higher_on']} of {c['clips']} clips"
        row = (c["measure"], claim, clips, f"{c['difference']:+.3f}", *numbers, verdict)
        lines.append(f"| {' | '.join(row)} |")
    scaled = cells(runs, "eval_imitation", gains=True)
    if scaled:
        lines += ["", "## Gains scaled in training: imitation reward a step", "", *_table(scaled, 2)]
    if times:
        title = f"One control step of one character, ms of processor time ({times['clip']})"
        lines += ["", f"## {title}", ""]
        lines += ["| setting and method | ms |", "|---|---|"]
        lines += [f"| {k} | {v:.2f} |" for k, v in times["ms"].items()]
    return "\n".join(lines) + "\n"


def figure(runs: Runs, columns: int = 2) -> str:
    """One SVG with a panel of learning curves for each clip: mean over seeds, their range as a band."""
    clips = sorted({n.split("/")[0] for n, r in runs.items() if r["curve"]})
    panels = []
    for clip in clips:
        series = []
        for method in TITLES:
            names = [n for n in runs if n.split("/")[:2] == [clip, method] and n.count("/") == 2]
            curves = [np.array(runs[n]["curve"]) for n in names if runs[n]["curve"]]
            if curves:
                x = curves[0][:, 0]
                y = np.array([np.interp(x, c[:, 0], c[:, 1] * c[:, 2]) for c in curves])
                series.append((method, x, y.mean(0), (y.min(0), y.max(0))))
        panels.append(line_plot(series, clip, "samples", "return per episode", zero=True))
    wide, high = 560, 320
    size = (wide * min(columns, len(panels)), high * math.ceil(len(panels) / columns))
    placed = [
        p.replace("<svg ", f'<svg x="{wide * (k % columns)}" y="{high * (k // columns)}" ', 1)
        for k, p in enumerate(panels)
    ]
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size[0]} {size[1]}" role="img"'
    return f'{head} aria-label="Return per episode over samples">{"".join(placed)}</svg>\n'


def write(out: Path, command: str, runs: Runs, times: dict[str, Any] | None) -> None:
    """JSON, tables and figure beside each other, named as `out`."""
    if not runs:
        return
    runs = {name: runs[name] for name in sorted(runs)}
    means: dict[str, Any] = {key: {} for key, *_ in MEASURES}
    for key, methods in means.items():
        for method, row in cells(runs, key).items():
            methods[method] = {c: _rounded(float(np.mean(v))) for c, v in row.items()}
    head = {"command": command, "rule": RULE, "means": means, "orders": comparisons(runs)}
    head["control_step_ms"] = times
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(run)}" for name, run in runs.items())
    text = json.dumps(head, indent=1).rstrip("}").rstrip()
    out.write_text(f'{text},\n "runs": {{\n{lines}\n }}\n}}\n')
    out.with_suffix(".md").write_text(markdown(command, runs, times, out.stem))
    if any(r["curve"] for r in runs.values()):
        out.with_suffix(".svg").write_text(figure(runs))
