"""The score table: every figure of score.json with its unit, beside the clip's own where known."""

from __future__ import annotations

from typing import Any, NamedTuple

from poise.view.data import number
from poise.view.verdict import cut, percent

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
_HELP: tuple[tuple[str, str, str, str], ...] = (
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


class Row(NamedTuple):
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


def score_rows(score: dict[str, Any]) -> list[Row]:
    """The whole score as rows of a table; keys that are not known are listed last as they are."""
    raw = score.get("reference")
    before: dict[str, Any] = raw if isinstance(raw, dict) else {}
    share = number(score.get("succ"))
    rule = str(score.get("succ_rule") or "share of starts that reach the end")
    rows = [Row("Success", NONE if share is None else percent(share), "", rule)]
    if (whole := number(score.get("tracked"))) is not None:
        rows.append(Row("Tracked", percent(whole), "", "success, upright and on its feet"))
    for key, name, unit, meaning in _ROWS:
        mark = _mark(number(score.get(key)), number(before.get(key)))
        mark = "" if cut(score) and mark == "better" else mark
        beside = amount(before[key], unit) if key in before else ""
        rows.append(Row(name, amount(score.get(key), unit), beside, meaning, mark))
    reward = score.get("reward")
    total = reward.get("total") if isinstance(reward, dict) else reward
    if number(total) is not None:
        rows.append(Row("Reward", amount(total), "", "mean per step"))
    table = score.get("help")
    if isinstance(table, dict):
        known = {key for key, *_ in _HELP}
        for key, name, unit, text in _HELP:
            rows.append(Row(f"Help: {name.lower()}", amount(table.get(key), unit), "", text))
        rows += [Row(f"Help: {key}", amount(v)) for key, v in table.items() if key not in known]
    rows += [Row(name, amount(score.get(key), unit), "", text) for key, name, unit, text in _RUN]
    listed = _SPECIAL | {key for key, *_ in _ROWS + _RUN}
    rest = {k: v for k, v in score.items() if k not in listed and not isinstance(v, dict | list)}
    return rows + [Row(str(k), amount(v)) for k, v in rest.items()]
