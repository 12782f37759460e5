"""The report: one self-contained page that opens offline and shows how good a result is."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poise.errors import PoiseError
from poise.formats.text import write_whole
from poise.score.report.data import Report, body_weight, number, payload, safe_json
from poise.score.report.svg import bar_plot, line_plot
from poise.score.report.verdict import cut, grades, overall, percent, sentence

_CLOCK = (("hours", 3600.0, 7200.0), ("minutes", 60.0, 300.0), ("seconds", 1.0, -math.inf))
_SIM, _REF, _HELP, _HELP2 = "var(--sim)", "var(--ref)", "var(--help)", "var(--contact)"


class Figure(NamedTuple):
    """One figure of the page.

    Attributes:
        title: its heading.
        text: what it shows, or why there is nothing to show.
        plot: the SVG, "" where there is nothing to show.
        legend: names and colours of its lines.
        unit: of the horizontal axis.
        time: whether that axis is the replay's time.
    """

    title: str
    text: str
    plot: str = ""
    legend: tuple[tuple[str, str], ...] = ()
    unit: str = ""
    time: bool = False


def figures(report: Report) -> tuple[Figure, ...]:
    """The four figures: error and help per frame, learning curve, reward terms."""
    return _error(report), _help(report), _curve(report), _reward(report)


def _error(report: Report) -> Figure:
    title = "Error per frame"
    local = np.asarray(report.error_mm, dtype=np.float64)
    world = np.asarray(report.error_global_mm, dtype=np.float64)
    if not (np.isfinite(local).any() or np.isfinite(world).any()):
        return Figure(title, "No error was measured for this clip.")
    at = np.arange(len(local)) / report.fps
    names = ("pose, relative to the root", "in the world, drift included")
    colors = (_SIM, _REF)
    body = line_plot(
        [(names[0], at, local), (names[1], at, world)],
        "Mean joint error per frame",
        "time (s)",
        "mean joint error (mm)",
        zero=True,
        colors=colors,
        inline=True,
    )
    text = f"Mean distance between the joints of simulation and reference.{_changed(report)}"
    return Figure(title, text, body, tuple(zip(names, colors, strict=True)), "s", True)


def _changed(report: Report) -> str:
    """The spells that physics changed most, by body; the replay leads there by its time."""
    told = [
        f"{c['body']} by up to {c['most_mm']:.0f} mm at {c['start_s']:.1f} to {c['stop_s']:.1f} s"
        for c in report.score.get("changed") or ()
    ]
    return f" Physics changed most: {'; '.join(told)}." if told else ""


def _help(report: Report) -> Figure:
    title = "Help per frame"
    if report.force is None and report.torque is None:
        return Figure(title, "No residual force was recorded for this run.")
    series: list[tuple[str, np.ndarray, np.ndarray]] = []
    colors: list[str] = []
    for name, vector, color in (
        ("force (N)", report.force, _HELP),
        ("torque (N m)", report.torque, _HELP2),
    ):
        if vector is not None:
            size = np.linalg.norm(np.asarray(vector, dtype=np.float64), axis=1)
            series.append((name, np.arange(len(size)) / report.fps, size))
            colors.append(color)
    weight = body_weight(report)
    right = ("force (% of body weight)", 100.0 / weight) if weight and report.force is not None else None
    label = " · ".join(name for name, *_ in series)
    body = line_plot(
        series, "Help per frame", "time (s)", label, zero=True, right=right, colors=colors, inline=True
    )
    legend = tuple((name, c) for (name, *_), c in zip(series, colors, strict=True))
    text = "What the residual force and torque on the root add from outside."
    return Figure(title, text, body, legend, "s", True)


def _columns(curve: dict[str, np.ndarray], name: str, count: int | None = None) -> np.ndarray | None:
    values = curve.get(name)
    if values is None:
        return None
    out = np.asarray(values, dtype=np.float64).reshape(-1)
    return out if np.isfinite(out).any() and (count is None or len(out) == count) else None


def _curve(report: Report) -> Figure:
    title = "Learning curve"
    reward = _columns(report.curve, "reward")
    if reward is None:
        return Figure(title, "No learning curve: nothing was learned, or it was not kept.")
    samples, seconds = (_columns(report.curve, k, len(reward)) for k in ("samples", "seconds"))
    x, label, unit = np.arange(len(reward), dtype=np.float64), "iteration", "iterations"
    top: tuple[str, Callable[[float], float]] | None = None
    if samples is not None:
        x, label, unit = samples, "samples", "samples"
        if seconds is not None and len(x) > 1:
            order = np.argsort(samples)
            known, clock = samples[order], seconds[order]
            longest = float(np.nanmax(clock))
            name, size = next(u for u in _CLOCK if longest > u[2])[:2]
            top = (f"wall clock ({name})", lambda v: float(np.interp(v, known, clock)) / size)
    elif seconds is not None:
        x, label, unit = seconds, "wall clock (s)", "s"
    body = line_plot(
        [("reward", x, reward)],
        "Learning curve",
        label,
        "mean reward",
        top=top,
        colors=(_SIM,),
        inline=True,
    )
    last = reward[np.isfinite(reward)][-1]
    return Figure(title, f"Mean reward while learning; last value {last:.3g}.", body, (), unit)


def _reward(report: Report) -> Figure:
    title = "Reward per term"
    reward = report.score.get("reward")
    if isinstance(reward, dict):
        known = ((str(k), number(v)) for k, v in reward.items() if k != "total")
        items = [(k, math.nan if v is None else v) for k, v in known]
        # A cost in units of its own, such as watts, would flatten the bars of the others.
        apart = [(k, v) for k, v in items if abs(v) > 1.0]
        apart = apart if len(apart) < len(items) else []
        items = [x for x in items if x not in apart]
        if items:
            finite = [v for _, v in items if math.isfinite(v)]
            most = 1.0 if finite and max(finite) <= 1.0 and max(finite) > 0.2 else None
            body = bar_plot(
                items, "Reward per term", "mean reward per step", most=most, color=_SIM, inline=True
            )
            total = number(reward.get("total"))
            whole = "" if total is None else f" Weighted total: {total:.3f}."
            costs = f" Not drawn: {', '.join(f'{k} {v:.4g}' for k, v in apart)}." if apart else ""
            text = f"Averages over the evaluated frames, not weighted.{whole}{costs}"
            return Figure(title, text, body)
    value = number(reward.get("total") if isinstance(reward, dict) else reward)
    text = "No reward was recorded." if value is None else f"Only the total was recorded: {value:.3f}."
    return Figure(title, text)


def notes(report: Report, held_reference: int, held_simulated: int) -> list[str]:
    """What was guessed, repaired or limited, and frames that could not be drawn."""
    lines = list(report.notes)
    for track, held in ((report.reference, held_reference), (report.simulated, held_simulated)):
        if held:
            lines.append(
                f"{held} frame{'s' if held > 1 else ''} of '{track.name}' had values that "
                "are not finite; the replay holds the last good pose there."
            )
    return lines


def facts(report: Report) -> dict[str, str]:
    """Clip, method, seed and so on."""
    return report.facts or {"frames": str(len(report.error_mm)), "fps": f"{report.fps:g}"}


_ROWS: tuple[tuple[str, str, str, str], ...] = (
    ("mpjpe_mm", "Joint error", "mm", "mean joint distance after the roots are laid together"),
    ("mpjpe_global_mm", "Joint error in the world", "mm", "the same in place: drift counts"),
    ("vel_mm_per_frame", "Velocity error", "mm/frame", "how far the joints' velocities are apart"),
    ("acc_mm_per_frame2", "Acceleration error", "mm/frame²", "the same of accelerations; shaking shows"),
    ("foot_slide_mm_per_s", "Foot slide", "mm/s", "speed of the feet over the ground while they bear"),
    ("penetration_mm", "Penetration", "mm", "how deep the body sinks into the ground"),
    ("float_mm", "Floating", "mm", "how far the body hovers where it should touch"),
    ("jerk", "Jerk", "m/s³", "change of acceleration; smoother motion has less"),
)
_TABLE_HELP: tuple[tuple[str, str, str, str], ...] = (
    ("limit_n", "Force limit", "N", "the most the residual force may give"),
    ("limit_nm", "Torque limit", "N m", "the most the residual torque may give"),
    ("force_mean_n", "Force, mean", "N", "what it did give"),
    ("force_p95_n", "Force, 95th percentile", "N", "what it gave in its busiest twentieth"),
    ("torque_mean_nm", "Torque, mean", "N m", ""),
    ("torque_p95_nm", "Torque, 95th percentile", "N m", ""),
    ("work_j_per_s", "Work", "J/s", "power that came from outside"),
    ("share_of_body_weight", "Share of body weight", "%", "mean force over the character's weight"),
)
_RUN: tuple[tuple[str, str, str, str], ...] = (
    ("seconds", "Learning time", "s", "wall clock"),
    ("samples", "Samples", "", "steps of simulated experience"),
    ("seed", "Seed", "", "the run repeats with it"),
)
NONE = "\u2013"
"""Stands where nothing was measured."""

_SPECIAL = {"succ", "tracked", "succ_rule", "reward", "help", "reference"}


def amount(value: Any, unit: str = "") -> str:
    """A figure with its unit, or a dash where there is none."""
    size = number(value)
    if size is None:
        return value if isinstance(value, str) else NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    if unit == "%":
        return percent(size)
    if abs(size) >= 1000 or float(size).is_integer():
        text = f"{size:,.0f}".replace(",", "\u202f")
    else:
        text = f"{size:.1f}" if abs(size) >= 10 else f"{size:.3g}"
    return f"{text} {unit}".rstrip()


class FigureRow(NamedTuple):
    """One figure of the table: what it is called, its amount and the clip's own, what it means, and
    whether it is "better" or "worse" than the clip's, else ""."""

    name: str
    value: str
    before: str = ""
    meaning: str = ""
    mark: str = ""


def _mark(after: float | None, before: float | None) -> str:
    """Better or worse than the clip itself, with a tenth of tolerance; less is always better."""
    if after is None or before is None or abs(after - before) <= 0.1 * abs(before):
        return ""
    return "better" if after < before else "worse"


def score_rows(score: dict[str, Any]) -> list[FigureRow]:
    """The whole score as rows of a table; keys that are not known are listed last as they are."""
    raw = score.get("reference")
    before: dict[str, Any] = raw if isinstance(raw, dict) else {}
    share = number(score.get("succ"))
    rule = str(score.get("succ_rule") or "share of starts that reach the end")
    rows = [FigureRow("Success", NONE if share is None else percent(share), "", rule)]
    if (whole := number(score.get("tracked"))) is not None:
        rows.append(FigureRow("Tracked", percent(whole), "", "success, upright and on its feet"))
    for key, name, unit, meaning in _ROWS:
        mark = _mark(number(score.get(key)), number(before.get(key)))
        mark = "" if cut(score) and mark == "better" else mark
        beside = amount(before[key], unit) if key in before else ""
        rows.append(FigureRow(name, amount(score.get(key), unit), beside, meaning, mark))
    reward = score.get("reward")
    total = reward.get("total") if isinstance(reward, dict) else reward
    if number(total) is not None:
        rows.append(FigureRow("Reward", amount(total), "", "mean per step"))
    table = score.get("help")
    if isinstance(table, dict):
        known = {key for key, *_ in _TABLE_HELP}
        for key, name, unit, text in _TABLE_HELP:
            rows.append(FigureRow(f"Help: {name.lower()}", amount(table.get(key), unit), "", text))
        rows += [FigureRow(f"Help: {key}", amount(v)) for key, v in table.items() if key not in known]
    rows += [FigureRow(name, amount(score.get(key), unit), "", text) for key, name, unit, text in _RUN]
    listed = _SPECIAL | {key for key, *_ in _ROWS + _RUN}
    rest = {k: v for k, v in score.items() if k not in listed and not isinstance(v, dict | list)}
    return rows + [FigureRow(str(k), amount(v)) for k, v in rest.items()]


#: Losses that are named one by one.
NAMED = 8
_WORDS = {"good": "Good", "fair": "Fair", "poor": "Poor", "unknown": "Not fully judged"}


def _asset(name: str) -> str:
    return (files("poise.score.report") / "assets" / name).read_text(encoding="utf-8").strip()


def render(report: Report) -> str:
    """The whole page as text; everything from outside is escaped and nothing is fetched."""
    from jinja2 import Environment, StrictUndefined

    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    data, level = payload(report), overall(report.score)
    return page.from_string(_asset("report.html")).render(
        asset=_asset,
        report=report,
        level=level,
        word=_WORDS[level],
        sentence=sentence(report.score),
        grades=grades(report.score),
        lost=", ".join(f"{t:.1f} s" for t in data["lost"][:NAMED]),
        more=max(0, len(data["lost"]) - NAMED),
        figures=figures(report),
        score=score_rows(report.score),
        notes=notes(report, data["reference"]["held"], data["simulated"]["held"]),
        facts=facts(report),
        motion=safe_json(data),
    )


def write_report(report: Report, path: Path) -> None:
    """Writes the page; a reader sees the old file or the whole new one, never a part.

    Raises:
        PoiseError: the folder cannot be made or written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"its folder cannot be made ({error.strerror})"
        raise PoiseError(what, path, "Choose another folder", code="cannot-write") from error
    write_whole(path, render(report) + "\n")
