"""Endless motion for a character: a kinematic policy goes on from its own past, beside the loop."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Executor, Future

import numpy as np
import torch
from torch import Tensor

from poise.live.calibration import Elsewhere
from poise.synth.generator import Kinematic

#: Frames that wait at least; below it more are made.
AHEAD = 30


class Endless:
    """Coordinates of a body at the control rate, without end.

    Args:
        generator: makes them.
        seed: of its draws.
        executor: makes them beside the loop; None makes them at once, as tests do.
    """

    def __init__(self, generator: Kinematic, seed: int = 0, executor: Executor | None = None):
        self._generator, self._executor = generator, executor
        self._rng = torch.Generator().manual_seed(seed)
        self._past = generator.begin(1, self._rng)
        self._frames = deque[np.ndarray]()
        self._made: Future[Tensor] | None = None
        self._last: np.ndarray | None = None
        self._where = Elsewhere()

    def next(self, waits: bool = False) -> np.ndarray | None:
        """The next frame `(7 + n)`; None before any was made.

        waits: the character has lost it, and it waits for it.
        """
        self._more()
        if self._frames and not (waits and self._last is not None):
            self._last = self._frames.popleft()
        return None if self._last is None else self._where(self._last)

    def move(self, seen: np.ndarray, to: np.ndarray) -> None:
        """Lets it go on so that the coordinates `seen (7 + n)` are where and face as `to` does."""
        self._where.move(seen, to)

    def _more(self) -> None:
        if self._made is not None and self._made.done():
            made, self._made = self._made.result(), None
            self._past = torch.cat((self._past, made), 1)[:, -self._generator.past :]
            self._frames.extend(made[0].numpy())
        if self._made is None and len(self._frames) < AHEAD:
            if self._executor is not None:
                self._made = self._executor.submit(self._make)
            else:
                self._made = Future()
                self._made.set_result(self._make())

    def _make(self) -> Tensor:
        return self._generator.generate(self._past, torch.zeros(1, dtype=torch.long), self._rng)
