"""When a stage of training has learned what it can: its success no longer improves (PHC, 3.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.state import State, take

#: "go on" training this stage, go to the "next" one, or "solved": no clip fails, training ends.
Decision = Literal["go on", "next", "solved"]


@dataclass(frozen=True)
class ConvergenceConfig:
    """When to stop a stage, in evaluations of its clips."""

    patience: int = 3
    """Evaluations in a row without a gain after which the stage ends."""
    gain: float = 0.0
    """An improvement is a success rate above the best so far by more than this."""
    least: int = 1
    """Evaluations that a stage gets in any case, unless it is solved."""
    most: int | None = None
    """Evaluations after which it ends in any case."""

    def __post_init__(self) -> None:
        if self.patience < 1 or self.least < 1 or (self.most is not None and self.most < self.least):
            raise PoiseError(f"a stage cannot end by {self}", "ConvergenceConfig")


class Convergence:
    """Counts evaluations of one stage; `best` is the highest success rate, at evaluation `best_at`."""

    def __init__(self, config: ConvergenceConfig | None = None):
        self.config = config or ConvergenceConfig()
        self.reset()

    def reset(self) -> None:
        """Begins another stage."""
        self.best, self.best_at, self.evaluations = -1.0, 0, 0

    def add(self, succeeded: int, total: int, improved: bool = False) -> Decision:
        """Notes an evaluation of the stage's hard set, of `total` clips, and decides.

        An empty hard set is solved: there is nothing left to learn. improved: something else was
        gained, such as help that was taken away, so that the stage's patience begins anew.
        """
        if not 0 <= succeeded <= total:
            raise PoiseError(f"{succeeded} of {total} clips cannot have succeeded")
        self.evaluations += 1
        rate = succeeded / total if total else 1.0
        if rate > self.best + self.config.gain or self.evaluations == 1:
            self.best, self.best_at = rate, self.evaluations
        if improved:
            self.best_at = self.evaluations
        if succeeded == total:
            return "solved"
        c = self.config
        stale = self.evaluations - self.best_at >= c.patience and self.evaluations >= c.least
        return "next" if stale or self.evaluations == c.most else "go on"

    def state(self) -> State:
        """The counts."""
        return {"convergence": torch.tensor([self.best, self.best_at, self.evaluations]).double()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from what `state` returned."""
        best, best_at, evaluations = take(state, "convergence").tolist()
        self.best, self.best_at, self.evaluations = best, int(best_at), int(evaluations)
