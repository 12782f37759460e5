"""Where the training of a library stands: its stage, its share of the limits, what it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from poise.eval import ClipResults, RecoveryCard
from poise.learn import IterationStats, Until
from poise.recipes.perpetual.config import Recovers

Kind = Literal["primitive", "single", "joint", "recovery", "composer"]


@dataclass(frozen=True)
class Stage:
    """One training after another, see `perpetual.plan`.

    Attributes:
        number: counts all stages of a run from 1.
        mixed: episodes of recovery are interleaved.
    """

    kind: Kind
    number: int = 1
    mixed: bool = False

    @property
    def name(self) -> str:
        """As it is shown and noted: "primitive 2"."""
        if self.kind == "primitive":
            return f"primitive {self.number}"
        return f"{self.kind} with recovery" if self.mixed and self.kind != "composer" else self.kind

    @property
    def recovers(self) -> Recovers | None:
        """As what the stage learns recovery; None: it tracks alone."""
        if self.kind == "recovery":
            return "primitive"
        return "composer" if self.mixed else None


@dataclass(frozen=True)
class Progress:
    """What one iteration came to.

    Attributes:
        stage: the one that was trained.
        iteration: over all stages.
        share: of the whole training, 0 to 1.
        clips: of the stage; of the recovery primitive, its trials.
        succeeded: how many of the `clips` succeeded in the last evaluation; None before the first.
        help_n: N, the help that is left on the clip that has most.
        results, recovery: evaluations that were made after this iteration.
        following: the stage that begins now.
        trouble: why training diverged before this iteration, which then was made again from the last
            checkpoint; empty without a divergence.
    """

    stage: Stage
    iteration: int
    stats: IterationStats
    share: float
    succeeded: int | None
    clips: int
    help_n: float
    results: ClipResults | None
    recovery: RecoveryCard | None
    following: Stage | None
    trouble: str = ""


def share_of(until: Until, iterations: int, samples: int, seconds: float) -> float:
    """How much of the nearest limit is used up, 0 to 1."""
    used = (
        (seconds / 60, until.minutes), (iterations, until.iterations), (samples, until.samples)
    )  # fmt: skip
    return min(1.0, max(a / b if b else 1.0 for a, b in used if b is not None))
