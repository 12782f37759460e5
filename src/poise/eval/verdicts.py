"""A score card in words: labelled rows, each judged good, fair or poor by stated thresholds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

from poise.eval.card import ScoreCard

Verdict = Literal["good", "fair", "poor", ""]


@dataclass(frozen=True)
class Threshold:
    """Up to `good` is good, up to `fair` is fair, beyond is poor; at least instead when `more`."""

    good: float
    fair: float
    more: bool = False

    def verdict(self, value: float) -> Verdict:
        """ "" for a value that was not measured."""
        if not math.isfinite(value):
            return ""
        sign = -1.0 if self.more else 1.0
        if sign * value <= sign * self.good:
            return "good"
        return "fair" if sign * value <= sign * self.fair else "poor"


THRESHOLDS: Mapping[str, Threshold] = MappingProxyType(
    {
        "succ": Threshold(0.95, 0.80, more=True),
        "mpjpe_mm": Threshold(40.0, 80.0),
        "mpjpe_global_mm": Threshold(60.0, 120.0),
        "vel_mm_per_frame": Threshold(10.0, 20.0),
        "acc_mm_per_frame2": Threshold(7.0, 15.0),
        "foot_slide_mm_per_s": Threshold(100.0, 250.0),
        "penetration_mm": Threshold(5.0, 15.0),
        "float_mm": Threshold(10.0, 30.0),
        "jerk_ratio": Threshold(1.5, 3.0),
        "share_of_body_weight": Threshold(0.02, 0.10),
        "torque_mean_nm": Threshold(5.0, 25.0),
    }
)
"""By key of the score card, in its units; reasons in docs/metrics.md. `jerk_ratio` is jerk over the
reference's jerk."""


class Row(NamedTuple):
    """One line of the table; `value` is NaN where nothing was measured."""

    label: str
    value: float
    unit: str
    verdict: Verdict


_ROWS = (
    ("mpjpe_mm", "Joint error, root-relative", "mm"),
    ("mpjpe_global_mm", "Joint error, global", "mm"),
    ("vel_mm_per_frame", "Velocity error", "mm/frame"),
    ("acc_mm_per_frame2", "Acceleration error", "mm/frame²"),
    ("foot_slide_mm_per_s", "Foot slide", "mm/s"),
    ("penetration_mm", "Penetration", "mm"),
    ("float_mm", "Floating", "mm"),
    ("jerk", "Jerk", "m/s³"),
)


def table(card: ScoreCard) -> list[tuple[str, float, str, Verdict]]:
    """Rows (label, value, unit, verdict) for the command line and the report, most important first.

    Each plausibility row is followed by the reference's own figure, which gets no verdict.
    """
    t = THRESHOLDS
    rows: list[tuple[str, float, str, Verdict]] = [
        Row(f"Success ({card.succ_rule})", 100.0 * card.succ, "%", t["succ"].verdict(card.succ))
    ]
    for key, label, unit in _ROWS:
        value = getattr(card, key)
        reference = card.reference.get(key, math.nan)
        if key == "jerk":
            ratio = value / reference if reference > 0 else math.nan
            rows.append(Row(label, value, unit, t["jerk_ratio"].verdict(ratio)))
        else:
            rows.append(Row(label, value, unit, t[key].verdict(value)))
        if math.isfinite(reference):
            rows.append(Row(f"{label}, reference", reference, unit, ""))
    aid = card.help
    share = t["share_of_body_weight"].verdict(aid.share_of_body_weight)
    torque = t["torque_mean_nm"].verdict(aid.torque_mean_nm)
    rows += [
        Row("Help, share of body weight", 100.0 * aid.share_of_body_weight, "%", share),
        Row("Help, mean force", aid.force_mean_n, "N", ""),
        Row("Help, mean torque", aid.torque_mean_nm, "N m", torque),
        Row("Help, mean power", aid.work_j_per_s, "J/s", ""),
        Row("Reward per step", card.reward.get("total", math.nan), "", ""),
    ]
    return rows
