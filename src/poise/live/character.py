"""What one character is to do in each control step: the person's motion, standing at ease without one,
and after a fall a recovery motion, after which it goes on with the person."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.env.goals.led import REST, WAITS_S
from poise.env.recovery.get_up import GetUpPlanner
from poise.live.passing import Passing
from poise.live.ways import Way
from poise.metrics import LOST
from poise.spatial.directions import facing, heading_angle

#: What a character does.
EASE, TRACKS, FALLS, RETURNS = "at ease", "tracks", "falls", "gets up"
#: m that a standing person may be away for the character to walk there; m/s of one that stands.
WALKS_M, STANDS = 4.0, 0.5
#: m and rad between where a character has come back and its person, from which the person's motion is
#: moved there.
HERE_M, TURNED = 0.25, 0.5
#: s after a recovery motion began in which it is not lost.
GRACE_S = 0.3


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
        anew: whether the last frame begins a motion from where the body is, so that no frames before it
            count any more.
        still: whether the last two frames were the same.
    """

    def __init__(
        self,
        get_up: GetUpPlanner,
        place: tuple[float, float],
        executor: Executor | None = None,
        move: Callable[[Tensor, Tensor], None] | None = None,
    ):
        self.get_up, self._move = get_up, move
        self.ease = get_up.recovery_clips.ease.clone()
        self.ease[:2] = torch.tensor(place, dtype=torch.float64)
        self.doing = EASE
        self.lost = self.falls = self.recovered = 0
        self.last = self.ease.clone()
        self.anew, self.still = False, True
        self._way, self._passing, self._step = Way(get_up, executor), Passing(get_up.rate_hz), 0
        self._grace = self._tries = 0
        self._person: Tensor | None = None
        self._drift = torch.zeros(2, dtype=torch.float64)
        # Whether it is lost and not back yet, whether the person leapt, and how the last step broke.
        self._lost, self._jumped, self._was = False, False, ""

    def on_move(self, move: Callable[[Tensor, Tensor], None]) -> None:
        """Says what moves the person's motion, see `move`."""
        self._move = move

    def begin(self, frame: Tensor) -> None:
        """The character was set down on a frame."""
        self.last, self.doing = frame.clone(), EASE
        self._way.leave()
        self._stand(frame)
        self._drift = torch.zeros(2, dtype=torch.float64)
        self.blend()

    def follow(self, frame: Tensor) -> None:
        """The character is on its person's motion already, `frame` the last that its goal knows."""
        self.last, self.doing = frame.clone(), TRACKS
        self._passing.end()

    def jump(self) -> None:
        """The person is elsewhere of a sudden."""
        self._jumped = self.doing == TRACKS

    def blend(self) -> None:
        """What comes next is passed into from the last frame: a new person, a jump."""
        self._passing.begin(self.last, self._drift)

    def next(self, person: Tensor | None, body: Body, stalled: bool = False) -> Tensor:
        """The goal's next frame `(7 + n)`.

        Args:
            person: the person's motion now, None without one.
            stalled: nothing new has come of the person; its pose rests meanwhile.
        """
        before, self.anew = self.last, False
        self.last = self._next(person, body, stalled)
        self._drift = torch.zeros_like(self._drift) if self.anew else self.last[:2] - before[:2]
        self.still = bool((self.last - before).abs().max() < 1e-9)
        return self.last

    def _next(self, person: Tensor | None, body: Body, stalled: bool) -> Tensor:
        rate, self._step = self.get_up.rate_hz, self._step + 1
        step = self._moved(person)
        stands = float(step.norm()) * rate < STANDS
        if self.doing != FALLS and body.off_m > LOST and self._step > self._grace:
            self.lost, self._lost = self.lost + (not self._lost), True
            self._fall()
        if self.doing == FALLS:
            down = bool(self.get_up.lies(body.qpos))
            rests = body.speed < REST or self._step > WAITS_S * rate or not down
            if rests and not self._way.planned:
                self.falls += down
                near = person is not None and float((person[:2] - body.qpos[:2]).norm()) < WALKS_M
                place = person if near and stands else None
                # What has failed several times is not tried for ever.
                self._way.plan(body.qpos.clone(), place, body.moves, self._tries)
                self._tries += down
            if not self._sets_out(RETURNS):
                return self.last
        if self.doing == RETURNS:
            if (frame := self._way.next()) is not None:
                return frame
            self.recovered, self._lost, self._tries = self.recovered + self._lost, False, 0
            self._stand(self.last)
            self.doing = TRACKS
            return self._join(person, step)
        if stalled and self.doing == TRACKS and float(body.moves.norm()) > STANDS:
            # It walks to a halt.
            self._way.plan(body.qpos.clone(), None, body.moves)
            self.doing = EASE
            self._stand(self.last)
        if stalled and self.doing == EASE:
            person, step = None, torch.zeros_like(step)
        if (person is None) != (self.doing == EASE):
            self._stand(self.last)
            self.doing = EASE if person is None else TRACKS
            self._way.leave()
            return self._join(person, step)
        if self.doing == EASE and (self._way.on or self._way.planned):
            if not self._way.on and not self._sets_out(EASE):
                return self.last
            if (frame := self._way.next()) is not None:
                return frame
            self._stand(self.last)
            self._join(None, step)
        if person is not None and (why := self._broke(stalled)):
            if why == "leaps":
                # Whether the person stands there is known a step later.
                return self._on()
            if why == "leapt" and stands and self._away(person):
                self._fall()
                return self._on()
            return self._join(person, step)
        target = self.ease if person is None else person
        if self._passing.on:
            target = self._passing.next(target, step)
            if person is None:
                self.ease[:2] = target[:2]
            else:
                there = person.clone()
                there[:2] = target[:2]
                self._put(person, there)
        return target

    def _broke(self, stalled: bool) -> str:
        """Why the person's motion does not go on from what was read of it before; "" where it does."""
        before, self._was = self._was, "leaps" if self._jumped else "stalls" if stalled else ""
        self._jumped = False
        if self._was == "leaps":
            return self._was
        if before == "leaps":
            return "leapt"
        return "stalled" if before == "stalls" and not stalled else ""

    def _fall(self) -> None:
        self.doing, self._step = FALLS, 0
        self._way.leave()

    def _sets_out(self, doing: str) -> bool:
        """Whether a recovery motion begins now."""
        if not self._way.begins():
            return False
        self.doing, self._step, self.anew = doing, 0, True
        self._grace = round(GRACE_S * self.get_up.rate_hz)
        return True

    def _on(self) -> Tensor:
        """The last frame a step further."""
        out = self.last.clone()
        out[:2] += self._drift
        return out

    def _join(self, person: Tensor | None, step: Tensor) -> Tensor:
        """Begins to pass into what the person does, or to ease, from how the goal moves."""
        self.blend()
        if person is None:
            return self._on()
        there = self._on() if self._away(person) else person.clone()
        there[:2] = self._on()[:2]
        self._put(person, there)
        return self._on()

    def _put(self, person: Tensor, there: Tensor) -> None:
        """Lets the person's motion go on from elsewhere."""
        if self._move is not None:
            self._move(person, there)
        turns = heading_angle(there[3:7]) - heading_angle(person[3:7])
        self._person = there if abs(turns) < 1e-6 else None

    def _moved(self, person: Tensor | None) -> Tensor:
        """m `(2)` by which the person's root moved since the last step, wherever it was put since."""
        before, self._person = self._person, person
        if person is None or before is None:
            return torch.zeros(2, dtype=torch.float64)
        return person[:2] - before[:2]

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


def tensor(qpos: np.ndarray) -> Tensor:
    """Coordinates as the goals have them."""
    return torch.from_numpy(np.ascontiguousarray(qpos))
