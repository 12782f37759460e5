"""Training that goes on where a simulation goes bad, as one world in millions of steps may do."""

from __future__ import annotations

from collections.abc import Callable

from poise.learn import IterationStats, Trainer
from poise.sim import UnstableError

#: Simulations that may go bad between two evaluations.
MOST = 5


class DivergenceRetry:
    """How often a simulation went bad in all, and since the last evaluation."""

    def __init__(self, total: int = 0, lately: int = 0):
        self.total, self.lately = total, lately

    def iterate(self, trainer: Trainer, go_back: Callable[[int], None]) -> tuple[IterationStats, str]:
        """One iteration, and what went wrong before it.

        go_back: takes the trainer to its last checkpoint, with draws of the number that it is told,
        since the same ones would end there again.

        Raises:
            UnstableError: it happens again and again.
        """
        trouble = ""
        while True:
            try:
                return trainer.iterate(), trouble
            except UnstableError as problem:
                if self.lately >= MOST:
                    raise
                trouble = str(problem)
                self.total, self.lately = self.total + 1, self.lately + 1
                go_back(self.total)
