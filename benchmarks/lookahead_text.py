"""The results of `lookahead.py` as Markdown tables and as the budget curve.

    python benchmarks/lookahead_text.py benchmarks/lookahead.json [docs/benchmarks.md]

A page that is given holds two lines `<!-- lookahead -->`, between which the tables are put.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from field.sources import by_source
from lookahead_figures import (
    Row,
    budget,
    decision,
    episodes,
    groups,
    jerk_ratio,
    mean,
    median,
    named,
    ordered,
    share,
    slides_as_source,
    stands_as_source,
    steps,
    success,
)
from lookahead_sets import CONDITIONS

from poise.learn.checkpoint import write_atomic
from poise.score.report.svg import line_plot

MARK = "<!-- lookahead -->"


# --- tables ---------------------------------------------------------------------------------------


def sets(rows: Sequence[Row]) -> list[str]:
    """How near and how clean, set by set."""
    plain = [r for r in ordered(rows) if r["condition"] == "none"]
    near = [("clips", "starts", "controller", "done whole", "part done", "g-MPJPE, mm",
             "g-MPJPE of all frames", "MPJPE, mm", "MPJPE of all frames", "E_acc, mm/frame²",
             "E_vel, mm/frame")]  # fmt: skip
    clean = [("clips", "controller", "jerk / source", "slide, source, mm/s", "slides as source",
              "sole contacts / source", "stands as source", "penetration, source, mm",
              "floating, source, mm")]  # fmt: skip
    for (name, starts), own in groups(plain, "set", "starts").items():
        tried = groups(own, "controller", "budget")
        most = max((len(g) for (by, _), g in tried.items() if by == "lookahead"), default=0)
        for (controller, _), g in tried.items():
            # Budgets that few clips were tried with have a table of their own.
            if controller == "lookahead" and len(g) < most:
                continue
            by = named(g[0])
            near.append((
                f"{len(g)} of {name}", str(starts), by, _share(*success(g)), _percent(mean(g, "part")),
                _number(median(g, "error_mm")), _number(mean(g, "error_uncut_mm")),
                _number(median(g, "root_error_mm")), _number(mean(g, "root_error_uncut_mm")),
                _number(median(g, "acc"), 1), _number(median(g, "vel"), 1),
            ))  # fmt: skip
            if not episodes(g, whole=True):
                continue
            clean.append((
                f"{len(episodes(g, whole=True))} of {name}", by, _number(median(g, jerk_ratio), 1),
                _pair(g, "slide"), _percent(share(g, slides_as_source)),
                _number(median(g, "stance_ratio"), 2), _percent(share(g, stands_as_source)),
                _pair(g, "penetration", 1), _pair(g, "floating", 1),
            ))  # fmt: skip
    return [
        _lines(near), "",
        "Errors are medians of the episodes that were done whole; those of all frames are means of all "
        "episodes, with what follows a failure. How clean those are that were done whole:", "",
        _lines(clean),
    ]  # fmt: skip


def sources(rows: Sequence[Row]) -> list[str]:
    """Sets that come from several places, by source."""
    out = [
        (
            "clips",
            "source",
            "controller",
            "done whole",
            "g-MPJPE, mm",
            "g-MPJPE of all frames",
            "jerk / source",
        )
    ]
    plain = [r for r in ordered(rows) if r["condition"] == "none"]
    for (name, _), own in groups(plain, "set", "starts").items():
        found = by_source((r["clip"], r) for r in own)
        if len(found) == 1:
            continue
        for source, some in found.items():
            for _, g in groups(some, "controller", "budget").items():
                errors = _number(median(g, "error_mm")), _number(mean(g, "error_uncut_mm"))
                jerk = _number(median(g, jerk_ratio), 1)
                clips = f"{len(g)} of {name}"
                out.append((clips, source, named(g[0]), _share(*success(g)), *errors, jerk))
    return [_lines(out)] if len(out) > 1 else []


def robustness(rows: Sequence[Row]) -> list[str]:
    """Success under every condition, of the clips that were tried under all of them."""
    rows = [r for r in rows if r["controller"] != "nothing"]
    tried = groups(rows, "condition")
    if len(tried) < 2:
        return []
    same = set.intersection(*({(r["set"], r["clip"]) for r in g} for g in tried.values()))
    rows = [r for r in ordered(rows) if (r["set"], r["clip"]) in same]
    # The starts that conditions were tried with.
    starts = {r["starts"] for r in rows if r["condition"] != "none"}
    rows = [r for r in rows if r["starts"] in starts]
    budgets = {r["budget"] for r in rows if r["condition"] != "none"}
    controllers = {named(r): None for r in rows if r["budget"] in budgets}
    head = ["what goes wrong"]
    for by in controllers:
        head += [
            f"{by}: done whole",
            "g-MPJPE, mm",
            "jerk / source",
            "near the true motion",
            "off it, mm",
        ]
    out: list[Sequence[str]] = [head]
    told = groups(rows, "condition")
    for condition in (c for c in CONDITIONS if (c,) in told):
        g, cells = told[(condition,)], [condition]
        for by in controllers:
            own = [r for r in g if named(r) == by]
            if not own:
                cells += [""] * 5
                continue
            cells += [_share(*success(own)), _number(median(own, "error_mm")),
                      _number(median(own, jerk_ratio), 1)]  # fmt: skip
            if "true_whole" in own[0]["episodes"][0]:
                cells += [_share(*success(own, "true_whole")), _number(mean(own, "true_error_mm"))]
            else:
                cells += ["", ""]
        out.append(cells)
    return [f"{len(same)} clips.", "", _lines(out)]


def budget_table(rows: Sequence[Row]) -> list[str]:
    """What more simulated steps buy, and how long a decision takes."""
    found = budget(rows)
    if not found:
        return []
    out: list[Sequence[str]] = [("controller", "simulated for each step made", "done whole",
                                 "g-MPJPE, mm", "g-MPJPE of all frames", "jerk / source", "slide, mm/s",
                                 "a decision, ms: median, p99")]  # fmt: skip
    for by, g in found:
        times = decision(g)
        took = "" if math.isnan(times[0]) else f"{times[0]:.0f}, {times[1]:.0f}"
        out.append((
            by, f"{steps(g):.0f}", _share(*success(g)), _number(median(g, "error_mm")),
            _number(mean(g, "error_uncut_mm")), _number(median(g, jerk_ratio), 1),
            _number(median(g, "slide")), took,
        ))  # fmt: skip
    return [f"{len(found[0][1])} clips; one thread.", "", _lines(out)]


def curve(rows: Sequence[Row], path: Path) -> bool:
    """The budget curve: success, and error of all frames, jerk and slide as shares of the policy's."""
    found = budget(rows)
    if not found:
        return False
    x = [steps(g) for _, g in found]
    lines = {
        "error": [mean(g, "error_uncut_mm") for _, g in found],
        "jerk": [median(g, jerk_ratio) for _, g in found],
        "slide": [median(g, "slide") for _, g in found],
    }
    series = [("done whole", x, [100.0 * success(g)[0] for _, g in found])]
    for name, y in lines.items():
        series.append((name, x, [100.0 * v / y[0] if y[0] else math.nan for v in y]))
    title = "Looking ahead: error, jerk and slide beside the policy's"
    line_plot(series, title, "simulated steps for each that is made", "%", path, zero=True)
    return True


# --- writing --------------------------------------------------------------------------------------


def tables(rows: Sequence[Row], image: str = "") -> str:
    """All tables."""
    parts = (
        ("Sets of clips", sets(rows)), ("By source", sources(rows)),
        ("What goes wrong", robustness(rows)), ("Budget", budget_table(rows)),
    )  # fmt: skip
    out: list[str] = []
    for title, lines in parts:
        if lines:
            out += [f"**{title}.**", "", *lines, ""]
    made = [r["made_with"] for r in rows if r["controller"] == "lookahead"]
    if few := len(made) - max((made.count(m) for m in set(made)), default=0):
        out += [f"Of lookahead's {len(made)} rows {few} are of other settings than most.", ""]
    if image and budget(rows):
        out += [f"![Budget curve]({image})", ""]
    return "\n".join(out).rstrip() + "\n"


def write(rows: Sequence[Row], commands: Sequence[str], json_path: Path) -> list[Path]:
    """Tables and curve beside the JSON; the files."""
    image, page = json_path.with_name(f"{json_path.stem}_budget.svg"), json_path.with_suffix(".md")
    drawn = curve(rows, image)
    head = ["# Looking ahead: measured", "", *(f"    {c}" for c in commands), ""]
    write_atomic(page, ("\n".join(head) + "\n" + tables(rows, image.name)).encode())
    return [json_path, page, *([image] if drawn else [])]


def put_into(page: Path, text: str) -> None:
    """Replaces what a page has between its two marks."""
    before, first, rest = page.read_text(encoding="utf-8").partition(MARK)
    _, second, after = rest.partition(MARK)
    if not (first and second):
        sys.exit(f"{page} lacks two lines {MARK}")
    write_atomic(page, f"{before}{MARK}\n\n{text}\n{MARK}{after}".encode())


def _share(value: float, spread: float) -> str:
    return f"{100 * value:.0f} %" if math.isnan(spread) else f"{100 * value:.0f} ± {100 * spread:.0f} %"


def _percent(value: float) -> str:
    return "" if math.isnan(value) else f"{100 * value:.0f} %"


def _number(value: float, digits: int = 0) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _pair(rows: Sequence[Row], key: str, digits: int = 0) -> str:
    return f"{_number(median(rows, key), digits)}, {_number(median(rows, f'source_{key}'), digits)}"


def _lines(rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(r) + " |" for r in (rows[0], ["---"] * len(rows[0]), *rows[1:]))


def main() -> None:
    result = json.loads(Path(sys.argv[1]).read_text())
    write(result["rows"], result["commands"], Path(sys.argv[1]))
    name = f"../benchmarks/{Path(sys.argv[1]).stem}_budget.svg"
    for page in sys.argv[2:]:
        put_into(Path(page), tables(result["rows"], name))


if __name__ == "__main__":
    main()
