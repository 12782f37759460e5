"""Recovery motions that are planned beside the loop."""

from __future__ import annotations

from concurrent.futures import Executor, Future

from torch import Tensor

from poise.env.recovery.entry import way_to_stand
from poise.env.recovery.get_up import GetUpPlanner


class Way:
    """The motion of one character to standing: planned, then followed.

    Args:
        executor: plans beside the loop; None plans at once, as tests do.
    """

    def __init__(self, get_up: GetUpPlanner, executor: Executor | None = None):
        self.get_up, self._executor = get_up, executor
        self._plan: Future[Tensor] | None = None
        self._frames: Tensor | None = None
        self._step = 0

    @property
    def planned(self) -> bool:
        """Whether it is being planned."""
        return self._plan is not None

    @property
    def on(self) -> bool:
        """Whether it is followed."""
        return self._frames is not None

    def plan(self, start: Tensor, place: Tensor | None, moves: Tensor | None, again: int = 0) -> None:
        """Begins to plan from `start (7 + n)` to standing at `place (7 + n)`, None for on the spot.

        moves, again: see `plan_recovery`.
        """
        how, self._frames = (self.get_up, start, place, moves, again), None
        if self._executor is None:
            self._plan = Future()
            self._plan.set_result(way_to_stand(*how))
        else:
            self._plan = self._executor.submit(way_to_stand, *how)

    def begins(self) -> bool:
        """Whether it is planned by now, and followed from this step on."""
        if self._plan is None or not self._plan.done():
            return False
        self._frames, self._plan, self._step = self._plan.result(), None, -1
        return True

    def next(self) -> Tensor | None:
        """Its next frame; None at its end, where it is left."""
        self._step += 1
        if self._frames is not None and self._step < len(self._frames):
            return self._frames[self._step]
        self._frames = None
        return None

    def leave(self) -> None:
        """It is not followed any more."""
        self._plan = self._frames = None
