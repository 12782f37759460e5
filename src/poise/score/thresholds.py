"""The thresholds by which figures of a score card are good, fair or poor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

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
        "tracked": Threshold(0.95, 0.80, more=True),
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
"""By key of the score card, in its units; shown in docs/python.md. `jerk_ratio` is jerk over the
reference's jerk."""
