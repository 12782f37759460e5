"""What one character is to do in each control step: the person's motion, standing at ease without one,
endless motion, and after a fall a recovery motion, after which it goes on with the person."""

from __future__ import annotations

import math
from concurrent.futures import Executor, Future
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.env.recovery.get_up import GetUpPlanner, mixed, smooth
from poise.env.recovery.planner import way_to_stand
from poise.env.recovery.recovering import RecoveryPhases
from poise.metrics import LOST
from poise.motion.rotations import facing, heading_angle

#: s in which one motion passes into another at least; m/s^2 with which the root speeds up at most, on
#: average.
PASSES_S, SPEEDS_UP = 1.0, 1.5


class Crossfade:
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


class RecoveryMotion:
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

    @property
    def over(self) -> bool:
        """Whether its last frame was the last one given."""
        return self._frames is not None and self._step + 1 >= len(self._frames)

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


#: What a character does.
EASE, TRACKS, FALLS, RETURNS = "at ease", "tracks", "falls", "gets up"
#: m that a standing person may be away for the character to walk there; m/s of one that stands.
WALKS_M, STANDS = 4.0, 0.5
#: m and rad between where a character has come back and its person, from which the person's motion is
#: moved there.
HERE_M, TURNED = 0.25, 0.5
#: s after a recovery motion began in which it is not lost.
GRACE_S = 0.3
#: The one character of its phases.
ONLY = torch.zeros(1, dtype=torch.long)


class CharacterState(NamedTuple):
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


class CharacterGoals:
    """One character's goals, a frame at a time.

    Args:
        get_up: how the policy's library gets up.
        place: `(2)` m, where it stands at first.
        executor: plans recovery motions beside the loop; None plans at once, as tests do.

    Attributes:
        doing: `EASE`, `TRACKS`, `FALLS` or `RETURNS`.
        lost: how often it lost its goal; `falls`, how often it lay then; `recovered`, how often it was
            back.
        anew: whether the last frame begins a motion from where the body is, so that no frames before it
            count any more.
        still: whether the last two frames were the same.
        moved: coordinates of the person in the last step, and those at which and facing as which they
            are to be from now on; None where the person's motion goes on as it did.
    """

    def __init__(
        self,
        get_up: GetUpPlanner,
        place: tuple[float, float],
        executor: Executor | None = None,
    ):
        self.get_up = get_up
        self.moved: tuple[Tensor, Tensor] | None = None
        self.ease = get_up.recovery_clips.ease.clone()
        self.ease[:2] = torch.tensor(place, dtype=torch.float64)
        self._phases = RecoveryPhases(1, get_up.rate_hz, "cpu", hurries=True)
        # Whether it is at ease while it tracks.
        self._eases = True
        self.lost = self.falls = self.recovered = 0
        self.last = self.ease.clone()
        self.anew, self.still = False, True
        self._way, self._passing = RecoveryMotion(get_up, executor), Crossfade(get_up.rate_hz)
        # Control steps in which a recovery motion that has begun is not lost yet.
        self._grace = 0
        self._person: Tensor | None = None
        self._drift = torch.zeros(2, dtype=torch.float64)
        # Whether it is lost and not back yet, whether the person leapt, and how the last step broke.
        self._lost, self._jumped, self._was = False, False, ""

    @property
    def doing(self) -> str:
        """`EASE`, `TRACKS`, `FALLS` or `RETURNS`."""
        now = (TRACKS, FALLS, RETURNS)[int(self._phases.doing)]
        return EASE if self._eases and now == TRACKS else now

    @property
    def comes(self) -> bool:
        """Whether it is yet to come to its person's motion, or to come back to it."""
        return self.doing in (FALLS, RETURNS) or self._passing.on

    @property
    def goes_on(self) -> bool:
        """Whether it is on its person's motion, as that is."""
        return self.doing == TRACKS and not (self._passing.on or self._lost or self.anew)

    def passed(self, frame: Tensor) -> Tensor:
        """One more frame of a motion that it goes on with, as it is."""
        self._drift, self._person, self.last = frame[:2] - self.last[:2], frame.clone(), frame
        return frame

    def begin(self, frame: Tensor) -> None:
        """The character was set down on a frame."""
        self.last, self._eases = frame.clone(), True
        self._phases.begin(ONLY)
        self._way.leave()
        self._stand(frame)
        self._drift = torch.zeros(2, dtype=torch.float64)
        self.blend()

    def follow(self, frame: Tensor) -> None:
        """The character is on its person's motion already, `frame` the last that its goal knows."""
        self.last, self._eases = frame.clone(), False
        self._phases.begin(ONLY)
        self._passing.end()

    def jump(self) -> None:
        """The person is elsewhere of a sudden."""
        self._jumped = self.doing == TRACKS

    def blend(self) -> None:
        """What comes next is passed into from the last frame: a new person, a jump."""
        self._passing.begin(self.last, self._drift)

    def next(self, person: Tensor | None, body: CharacterState, stalled: bool = False) -> Tensor:
        """The goal's next frame `(7 + n)`.

        Args:
            person: the person's motion now, None without one.
            stalled: nothing new has come of the person; its pose rests meanwhile.
        """
        before, self.anew, self.moved = self.last, False, None
        self.last = self._next(person, body, stalled)
        self._drift = torch.zeros_like(self._drift) if self.anew else self.last[:2] - before[:2]
        self.still = bool((self.last - before).abs().max() < 1e-9)
        return self.last

    def _next(self, person: Tensor | None, body: CharacterState, stalled: bool) -> Tensor:
        step = self._moved(person)
        stands = float(step.norm()) * self.get_up.rate_hz < STANDS
        if self._watch(body, person if stands else None):
            self._stand(self.last)
            self._eases = False
            return self._join(person, step)
        if self.doing == FALLS and not self._sets_out():
            return self.last
        if self.doing == FALLS:
            self._phases.return_by(ONLY)
        if self.doing == RETURNS and (frame := self._way.next()) is not None:
            return frame
        if stalled and not self._eases and float(body.moves.norm()) > STANDS:
            # It walks to a halt.
            self._way.plan(body.qpos.clone(), None, body.moves)
            self._eases = True
            self._stand(self.last)
        if stalled and self._eases:
            person, step = None, torch.zeros_like(step)
        if (person is None) != self._eases:
            self._stand(self.last)
            self._eases = person is None
            self._way.leave()
            return self._join(person, step)
        if self._eases and (self._way.on or self._way.planned):
            if not self._way.on and not self._sets_out():
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

    def _watch(self, body: CharacterState, near: Tensor | None) -> bool:
        """Looks whether the goal is lost, and plans the way back; whether that has come to its end.

        near: the person where it stands, to which the character gets up if that is near.
        """
        self._grace = max(0, self._grace - 1)
        off = body.off_m > LOST and not self._grace
        if not off and self.doing not in (FALLS, RETURNS):
            return False
        down = bool(self.get_up.lies(body.qpos))
        given = (torch.tensor([x]) for x in (off, body.speed, down, self._way.over))
        lost, rests, back = (bool(x) for x in self._phases.watch(*given))
        if lost:
            self.lost, self._lost = self.lost + (not self._lost), True
            self._way.leave()
        if rests and not self._way.planned:
            self.falls += down
            if near is not None and float((near[:2] - body.qpos[:2]).norm()) >= WALKS_M:
                near = None
            # What has failed several times is not tried for ever.
            self._way.plan(body.qpos.clone(), near, body.moves, int(self._phases.vain))
        if back:
            self.recovered, self._lost = self.recovered + self._lost, False
            self._way.leave()
        return back

    def _fall(self) -> None:
        self._phases.fall(ONLY)
        self._way.leave()

    def _sets_out(self) -> bool:
        """Whether a recovery motion begins now."""
        if not self._way.begins():
            return False
        self.anew, self._grace = True, round(GRACE_S * self.get_up.rate_hz) + 1
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
        self.moved = person.clone(), there.clone()
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


#: Share by which motion is faster or slower while what is behind is caught up with, and s behind which
#: nothing is caught up with.
CATCHES_UP, GIVES_UP_S = 0.15, 1.5
