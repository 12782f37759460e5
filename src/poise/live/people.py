"""People of the streams: each is calibrated, read at even times, and followed by one character."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future

import numpy as np

from poise.live.buffer import JitterBuffer, Pose
from poise.live.calibration import OntoBody, Standing
from poise.live.packet import PEOPLE, Packet, Tremble

#: s without a packet after which a person is away, and after which it is forgotten.
AWAY_S, FORGET_S = 1.0, 20.0

#: What is asked of a person at first.
STAND = "stand still for 2 s"

#: Makes the calibration of a packet's skeleton from a clip; a sentence where that fails.
Calibrate = Callable[..., OntoBody | str]


class Person:
    """One person of a stream.

    Attributes:
        onto: how its poses come onto the body; None before it is calibrated.
        said: why it has no calibration yet.
    """

    def __init__(self, name: str, delay_s: float):
        self.name, self.buffer = name, JitterBuffer(delay_s)
        self.onto: OntoBody | None = None
        self.said = STAND
        self.arrived_s = -np.inf
        self._first: Packet | None = None
        self._standing = Standing()
        self._made: Future[OntoBody | str] | None = None

    @property
    def share(self) -> float:
        """0 to 1, how far the calibration is."""
        return 1.0 if self.onto is not None else self._standing.share

    def add(self, packet: Packet, arrived_s: float, calibrate: Callable[..., object]) -> None:
        """One more packet. calibrate: is called with a packet that has a clip to be calibrated by."""
        first = self._first
        other = first is not None and packet.skeleton is not first.skeleton
        if other and first is not None and not packet.skeleton.same_bones(first.skeleton, 0.005):
            self.forget()
        if self._first is None:
            self._first = packet
        self.arrived_s = arrived_s
        p, tremble = packet, packet.tremble or Tremble()
        self.buffer.add(p.time_s, arrived_s, p.root_pos, p.rot, p.places, tremble, p.held_s, p.earlier)
        if self.onto is None and self._made is None:
            whole = packet.whole or self._standing.add(packet)
            if whole is not None:
                self._made = calibrate_with(calibrate, packet, whole)

    def forget(self) -> None:
        """Another body stands there: it is calibrated anew."""
        self.buffer = JitterBuffer(self.buffer.delay_s)
        self.onto = self._made = self._first = None
        self._standing = Standing()

    def ready(self) -> bool:
        """Whether it is calibrated; takes over a calibration that was made beside the loop."""
        if self._made is not None and self._made.done():
            made, self._made = self._made.result(), None
            if isinstance(made, str):
                self.said, self._standing = made, Standing()
            else:
                self.onto = made
        return self.onto is not None

    def read(self, now_s: float) -> Pose | None:
        """Its pose, None before anything came or since it is away."""
        pose = self.buffer.read(now_s)
        return None if pose is None or pose.stale_s > AWAY_S else pose


def calibrate_with(
    calibrate: Callable[..., object], packet: Packet, whole: object
) -> Future[OntoBody | str]:
    """The calibration, as a future whatever `calibrate` gives."""
    made = calibrate(packet, whole)
    if isinstance(made, Future):
        return made
    out: Future[OntoBody | str] = Future()
    out.set_result(made)  # type: ignore[arg-type]
    return out


class People:
    """All people that are there, and which of them each character follows.

    Args:
        count: characters.
        calibrate: (packet, clip) to a calibration; beside the loop where `executor` is given.

    Attributes:
        follows: name of the person that each character follows, None for none.
        turned_away: people that found no place.
    """

    def __init__(
        self, count: int, delay_s: float, calibrate: Calibrate, executor: Executor | None = None
    ):
        self.delay_s, self._calibrate, self._executor = delay_s, calibrate, executor
        self.known: dict[str, Person] = {}
        self.follows: list[str | None] = [None] * count
        self.turned_away = 0

    def add(self, packets: dict[str, list[tuple[float, Packet]]]) -> None:
        """What came since the last control step."""
        for name, line in packets.items():
            person = self.known.get(name)
            if person is None:
                if len(self.known) >= PEOPLE:
                    self.turned_away += 1
                    continue
                person = self.known[name] = Person(name, self.delay_s)
            for arrived, packet in line:
                person.add(packet, arrived, self._start)
            if name not in self.follows and None in self.follows:
                self.follows[self.follows.index(None)] = name

    def _start(self, packet: Packet, whole: object) -> object:
        if self._executor is None:
            return self._calibrate(packet, whole)
        return self._executor.submit(self._calibrate, packet, whole)

    def tidy(self, now_s: float) -> None:
        """Forgets people that have been away for long; a character takes the next one."""
        gone = [n for n, p in self.known.items() if now_s - p.arrived_s > FORGET_S]
        for name in gone:
            del self.known[name]
            self.follows = [None if f == name else f for f in self.follows]

    def switch(self, character: int, name: str | None) -> None:
        """A character follows another person from now on, None for none; one that is followed
        already changes places."""
        if name is not None and name in self.follows:
            self.follows[self.follows.index(name)] = self.follows[character]
        self.follows[character] = name

    def of(self, character: int) -> Person | None:
        """The person that a character follows."""
        name = self.follows[character]
        return None if name is None else self.known.get(name)

    def delay(self, seconds: float) -> None:
        """Length of all buffers from now on."""
        self.delay_s = seconds
        for person in self.known.values():
            person.buffer.delay_s = seconds
