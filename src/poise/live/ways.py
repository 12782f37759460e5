"""Recovery motions that are planned beside the loop."""

from __future__ import annotations

from concurrent.futures import Executor, Future

from torch import Tensor

from poise.env.recovery.get_up import GetUpPlanner
from poise.env.recovery.planner import DOWN, plan_recovery
from poise.spatial.directions import facing, heading_angle

#: m/s^2 with which what moves comes to stand.
STOPS = 1.7


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

        moves: m/s `(2)` of a body that does not lie.
        again: how often a motion from there was lost in a row.
        """
        if self._low(start):
            moves = None
        self._frames = None
        if self._executor is None:
            self._plan = Future()
            self._plan.set_result(_planned(self.get_up, start, place, moves, again))
        else:
            self._plan = self._executor.submit(_planned, self.get_up, start, place, moves, again)

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

    def _low(self, start: Tensor) -> bool:
        return float(start[2]) < DOWN * float(self.get_up.recovery_clips.ease[2])


def _planned(
    get_up: GetUpPlanner, start: Tensor, place: Tensor | None, moves: Tensor | None, again: int
) -> Tensor:
    if place is None:
        low = float(start[2]) < DOWN * float(get_up.recovery_clips.ease[2])
        place = (get_up.up(start, again)[-1] if low else start).clone()
        if moves is not None:
            # x = v |v| / 2a: where what moves can stand.
            place[:2] += moves * float(moves.norm()) / (2 * STOPS)
    stand = facing(get_up.recovery_clips.ease, heading_angle(place[3:7]))
    stand[:2] = place[:2]
    return plan_recovery(get_up, start, stand, moves=moves, again=again)
