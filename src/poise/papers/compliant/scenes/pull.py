"""Standing or walking under a sustained pull at one hand (Deep Compliant Control)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from poise.body import Humanoid
from poise.env.events import Push
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.papers.compliant.scenes.stage import Stage, hand_of


@dataclass(frozen=True)
class Pull:
    """A constant force at one hand.

    Attributes:
        newtons: of it.
        side: of the hand.
        direction: of the force in the world, Z up, of any length.
        start_s: s, when it begins.
        lasts_s: s, for how long.
    """

    newtons: float = 20.0
    side: Literal["left", "right"] = "left"
    direction: tuple[float, float, float] = (0.0, 1.0, 0.0)
    start_s: float = 0.5
    lasts_s: float = 60.0

    def __post_init__(self) -> None:
        size = float(np.linalg.norm(self.direction))
        if not (0.0 < self.newtons < 1e4 and size > 0.0 and np.isfinite(size)):
            raise PoiseError("a pull needs a force above 0 N and a direction", "pull")
        if not (self.start_s >= 0.0 and self.lasts_s > 0.0):
            raise PoiseError("a pull begins at 0 s or later and lasts some time", "pull")

    def stage(self, humanoid: Humanoid, reference: Reference) -> Stage:
        """The force at the hand's centre of mass."""
        row = hand_of(humanoid, self.side, "pull")
        unit = np.asarray(self.direction) / np.linalg.norm(self.direction)
        x, y, z = (float(self.newtons * v) for v in unit)
        rate = reference.rate_hz
        steps = max(1, round(self.lasts_s * rate))
        return Stage(plugins=(Push(row, (x, y, z), round(self.start_s * rate), steps),))
