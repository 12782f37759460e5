"""A motion stage by stage: what each made of it, by the doctor's figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from poise.kin import examine
from poise.motion import Clip


@dataclass(frozen=True)
class Stage:
    """What one stage made.

    Attributes:
        name: of the stage.
        key_mm: mean distance of the joints from the keyframes, mm.
        sole_slide_mm_per_s, penetration_mm, float_mm, jerk_m_per_s3: see `poise doctor`; None where no
            human body is told by the joints' names.
        fastest_m_per_s: of all joints.
    """

    name: str
    key_mm: float
    sole_slide_mm_per_s: float | None
    penetration_mm: float | None
    float_mm: float | None
    jerk_m_per_s3: float | None
    fastest_m_per_s: float

    def sentence(self) -> str:
        """The figures in words."""
        parts = [f"keyframes off by {self.key_mm:.0f} mm"]
        if self.sole_slide_mm_per_s is not None:
            parts.append(f"soles slide at {self.sole_slide_mm_per_s:.0f} mm/s")
        if self.jerk_m_per_s3 is not None:
            parts.append(f"jerk {self.jerk_m_per_s3:.0f} m/s^3")
        return f"{self.name}: {', '.join(parts)}, fastest joint {self.fastest_m_per_s:.1f} m/s."

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def key_errors(made: Clip, source: Clip, keys: Sequence[int], at: Sequence[int]) -> tuple[float, ...]:
    """How far the joints are from each keyframe, mean, mm: of `made` in the frames `at`, of `source` in
    the frames `keys`. A motion that ends before one is where it ended."""
    have, wanted = made.positions(), source.positions()
    return tuple(
        1000 * float(np.linalg.norm(have[min(a, len(have) - 1)] - wanted[k], axis=-1).mean())
        for a, k in zip(at, keys, strict=True)
    )


def stage_of(name: str, made: Clip, key_mm: Sequence[float]) -> Stage:
    """The figures of a motion. key_mm: see `key_errors`."""
    figures, pos = examine(made).figures, made.positions()
    names = ("sole_slide_mm_per_s", "penetration_mm", "float_mm", "jerk_m_per_s3")
    speed = np.linalg.norm(np.diff(pos, axis=0), axis=-1).max() * made.fps
    slide, sinks, floats, jerk = (figures.get(n) for n in names)
    return Stage(name, float(np.mean(key_mm)), slide, sinks, floats, jerk, float(speed))
