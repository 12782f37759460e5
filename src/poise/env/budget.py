"""The help that the characters of an environment have left, while they learn."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from poise.control import HelpSchedule

#: How much older episodes count, at each decision, against the ones since the last.
KEPT = 0.8


class HelpBudget:
    """Scales the residual force's limits by what a schedule decides from the episodes' outcomes.

    scale: 0-dimensional float32, multiplied with the limits, where the worlds are; `now` is the same
        number for Python, which need not wait for a GPU. Without a schedule it stays as it is set.
    """

    def __init__(self, schedule: HelpSchedule | None = None, device: torch.device | str = "cpu"):
        self.schedule = schedule
        self.scale, self.now = torch.ones((), device=device), 1.0
        self.steps, self._ended, self._failed = 0, 0.0, 0.0

    def set(self, scale: float) -> None:
        """Takes a scale into use, in [0, 1]."""
        self.now = float(np.float32(scale))
        self.scale.fill_(self.now)

    @property
    def success(self) -> float:
        """Share of recent episodes that did not fail; NaN before the first has ended."""
        return 1.0 - self._failed / self._ended if self._ended else float("nan")

    def count(self, ended: int, failed: int) -> None:
        """One control step of all worlds, in which episodes ended, some of them by failure."""
        if self.schedule is None:
            return
        self.steps += 1
        self._ended += ended
        self._failed += failed
        if self.steps % self.schedule.every == 0:
            self.set(self.schedule.scale(self.now, self.steps, self.success))
            self._ended *= KEPT
            self._failed *= KEPT

    def state(self) -> Tensor:
        """What `load_state` takes: float64 `(4)`."""
        counts = (self.now, self.steps, self._ended, self._failed)
        return torch.tensor(counts, dtype=torch.float64)

    def load_state(self, state: Tensor) -> None:
        """Goes on from `state()`."""
        scale, steps, self._ended, self._failed = state.tolist()
        self.set(scale)
        self.steps = int(steps)


def scale_in(state: Mapping[str, Tensor]) -> float:
    """The scale of the help in a trainer's saved state; 1 where none was saved."""
    found = state.get("env/help")
    return 1.0 if found is None else float(found[0])
