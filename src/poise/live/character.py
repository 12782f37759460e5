"""What one character is to do in each control step: the person's motion, standing at ease without one,
and after a fall a recovery motion, after which it goes on with the person."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.env.goals.led import LOST, REST, WAITS_S
from poise.env.recovery.get_up import GetUpPlanner, mixed, smooth
from poise.env.recovery.planner import DOWN, plan_recovery
from poise.spatial.directions import facing, heading_angle

#: What a character does.
EASE, TRACKS, FALLS, RETURNS = "at ease", "tracks", "falls", "gets up"
#: s in which one motion passes into another.
BLEND_S = 0.7
#: m that a standing person may be away for the character to walk there; m/s of one that stands.
WALKS_M, STANDS = 4.0, 0.5
#: m and rad between where a character has come back and its person, from which the person's motion is
#: moved there.
HERE_M, TURNED = 0.25, 0.5


class Body(NamedTuple):
    """Where a character is.

    Attributes:
        qpos: `(7 + n)`.
        off_m: m between its bodies and its goal on average.
        speed: m/s of its bodies on average.
        moves: `(2)` m/s of its root.
    """

    qpos: Tensor
    off_m: float
    speed: float
    moves: Tensor


class Character:
    """One character's goals, a frame at a time.

    Args:
        get_up: how the policy's library gets up.
        place: `(2)` m, where it stands at first.
        executor: plans recovery motions beside the loop; None plans at once, as tests do.
        move: is told coordinates of the person, and those at which and facing as which they are to be
            from now on.

    Attributes:
        doing: `EASE`, `TRACKS`, `FALLS` or `RETURNS`.
        lost: how often it lost its goal; `falls`, how often it lay then; `recovered`, how often it was
            back.
    """

    def __init__(
        self,
        get_up: GetUpPlanner,
        place: tuple[float, float],
        executor: Executor | None = None,
        move: Callable[[Tensor, Tensor], None] | None = None,
    ):
        self.get_up, self._executor, self._move = get_up, executor, move
        self.ease = get_up.recovery_clips.ease.clone()
        self.ease[:2] = torch.tensor(place, dtype=torch.float64)
        self.doing = EASE
        self.lost = self.falls = self.recovered = 0
        self.last = self.ease.clone()
        self._from, self._share, self._step = self.last, 1.0, 0
        self._way: Tensor | None = None
        self._plan: Future[Tensor] | None = None
        self._grace = 0
        self._person: Tensor | None = None

    def on_move(self, move: Callable[[Tensor, Tensor], None]) -> None:
        """Says what moves the person's motion, see `move`."""
        self._move = move

    def begin(self, frame: Tensor) -> None:
        """The character was set down on a frame."""
        self.last, self.doing = frame.clone(), EASE
        self._way = self._plan = None
        self._stand(frame)
        self.blend()

    def follow(self, frame: Tensor) -> None:
        """The character is on its person's motion already, `frame` the last that its goal knows."""
        self.last, self.doing, self._share = frame.clone(), TRACKS, 1.0

    def jump(self) -> None:
        """The person is elsewhere of a sudden: the character stays, and then goes on from there."""
        if self.doing == TRACKS:
            self.lost += 1
            self.doing, self._step, self._way, self._plan = FALLS, 0, None, None

    def blend(self) -> None:
        """What comes next is passed into from the last frame: a new person, a jump."""
        self._from, self._share = self.last, 0.0

    def next(self, person: Tensor | None, body: Body, lead: int = 0) -> Tensor:
        """The goal's next frame `(7 + n)`.

        Args:
            person: the person's motion now, None without one.
            lead: control steps after which the frame is the goal.
        """
        rate, self._step = self.get_up.rate_hz, self._step + 1
        speed = self._speed(person)
        if self.doing in (EASE, TRACKS, RETURNS) and body.off_m > LOST and self._step > self._grace:
            self.lost += self.doing != RETURNS
            self.doing, self._step, self._way = FALLS, 0, None
        if self.doing == FALLS:
            down = float(body.qpos[2]) < DOWN * float(self.ease[2])
            rests = body.speed < REST or self._step > WAITS_S * rate or not down
            if rests and self._plan is None:
                self.falls += down
                self._begin(person if speed < STANDS else None, body)
            if self._plan is not None and self._plan.done():
                self._way, self._plan = self._plan.result(), None
                self.doing, self._step = RETURNS, 0
                self._grace = lead + round(0.3 * rate)
            if self.doing == FALLS:
                return self.last
        if self.doing == RETURNS and self._way is not None:
            if self._step < len(self._way):
                self.last = self._way[self._step]
                return self.last
            self.recovered += 1
            self._stand(self.last)
            self.doing, self._way = TRACKS, None
            self.blend()
            if person is not None and self._away(person) and self._move is not None:
                self._move(person, self.last)
                # What was read is of the old place.
                return self.last
        if (person is None) != (self.doing == EASE):
            if person is None:
                self._stand(self.last)
            self.doing = EASE if person is None else TRACKS
            self.blend()
            if person is not None and self._away(person) and self._move is not None:
                self._move(person, self.last)
                return self.last
        target = self.ease if person is None else person
        if self._share < 1.0:
            self._share = min(1.0, self._share + 1.0 / (BLEND_S * rate))
            share = smooth(torch.tensor([self._share], dtype=torch.float64))
            target = mixed(self._from[None], target[None], share)[0]
        self.last = target
        return target

    def _speed(self, person: Tensor | None) -> float:
        before, self._person = self._person, person
        if person is None or before is None:
            return 0.0
        return float((person[:2] - before[:2]).norm()) * self.get_up.rate_hz

    def _away(self, person: Tensor) -> bool:
        """Whether a person is elsewhere than the character's goal, or faces another way."""
        apart = heading_angle(person[3:7]) - heading_angle(self.last[3:7])
        far = float((person[:2] - self.last[:2]).norm())
        return far > HERE_M or abs(math.remainder(apart, 2 * math.pi)) > TURNED

    def _stand(self, like: Tensor) -> None:
        """Ease is where and how a frame stands."""
        ease = facing(self.get_up.recovery_clips.ease, heading_angle(like[3:7]))
        ease[:2] = like[:2]
        self.ease = ease

    def _begin(self, person: Tensor | None, body: Body) -> None:
        """Plans how to get up: to the person that stands near, else on the spot."""
        start = body.qpos.clone()
        near = person is not None and float((person[:2] - start[:2]).norm()) < WALKS_M
        place = person.clone() if near and person is not None else None
        moves = body.moves if float(start[2]) >= DOWN * float(self.ease[2]) else None
        if self._executor is None:
            self._plan = Future()
            self._plan.set_result(_planned(self.get_up, start, place, moves))
        else:
            self._plan = self._executor.submit(_planned, self.get_up, start, place, moves)


def _planned(get_up: GetUpPlanner, start: Tensor, place: Tensor | None, moves: Tensor | None) -> Tensor:
    """A recovery motion to standing at `place (7 + n)`, on the spot for None."""
    if place is None:
        low = float(start[2]) < DOWN * float(get_up.recovery_clips.ease[2])
        end = get_up.up(start)[-1] if low else start
        place, moves = end, None
    stand = facing(get_up.recovery_clips.ease, heading_angle(place[3:7]))
    stand[:2] = place[:2]
    return plan_recovery(get_up, start, stand, moves=moves)


def tensor(qpos: np.ndarray) -> Tensor:
    """Coordinates as the goals have them."""
    return torch.from_numpy(np.ascontiguousarray(qpos))
