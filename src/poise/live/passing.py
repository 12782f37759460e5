"""From one motion into another that does not wait: a person's, which goes on meanwhile."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.env.recovery.get_up import mixed, smooth

#: s in which one motion passes into another at least; m/s^2 with which the root speeds up at most, on
#: average.
PASSES_S, SPEEDS_UP = 1.0, 1.5


class Passing:
    """Lets a goal's motion pass into another one without a leap of its root.

    Poses are mixed by shares s from 0 to 1. The root's place is not: what moves has gone on by then, and
    a root that catches up with it would have to run. Its velocity is mixed instead,

        x' = (1 - s) v + s v_target,

    so that at the end it moves as the target does, from elsewhere: the caller moves the target there.

    Args:
        rate_hz: frames a second.

    Attributes:
        on: whether it is under way.
    """

    def __init__(self, rate_hz: float):
        self.rate_hz = rate_hz
        self._frame = torch.zeros(7, dtype=torch.float64)
        self._drift, self._at = self._frame[:2], self._frame[:2]
        self._share = 1.0

    @property
    def on(self) -> bool:
        """Whether it is under way."""
        return self._share < 1.0

    def begin(self, frame: Tensor, drift: Tensor) -> None:
        """From a frame `(7 + n)`; the root there moves by `drift (2)` m a step."""
        self._frame, self._drift, self._at, self._share = frame, drift, frame[:2].clone(), 0.0

    def end(self) -> None:
        """The motion is the other one's."""
        self._share = 1.0

    def next(self, target: Tensor, step: Tensor) -> Tensor:
        """The next frame toward `target (7 + n)`, which moved by `step (2)` m since the last one."""
        apart = float((step - self._drift).norm()) * self.rate_hz
        self._share = min(1.0, self._share + 1.0 / (max(PASSES_S, apart / SPEEDS_UP) * self.rate_hz))
        share = smooth(torch.tensor([self._share], dtype=torch.float64))
        out = mixed(self._frame[None], target[None], share)[0]
        self._at = self._at + torch.lerp(self._drift, step, share)
        out[:2] = self._at
        return out
