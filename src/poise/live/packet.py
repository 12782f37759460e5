"""What a source sends: one pose of one person at one time, and the box in which the loop finds them."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from poise.errors import PoiseError
from poise.live.quats import normalized
from poise.motion import Clip, Skeleton

#: Packets of one person that wait at most; the newest win.
WAIT = 64
#: People of all sources together.
PEOPLE = 32
#: m from the origin beyond which nothing is believed.
FAR_M = 1000.0
#: Letters of a person's name.
NAME = 64


class Tremble(NamedTuple):
    """What a person was found to do: mm that it trembles by, 0 for one that is left as it is; Hz of a
    tremble of one frequency; s by which it is read later, to be smoothed."""

    mm: float = 0.0
    hz: float | None = None
    late_s: float = 0.0


class Earlier(NamedTuple):
    """When a pose was, its root `(3)` m and local rotations `(J, 4)` as they are known later."""

    time_s: float
    root_pos: np.ndarray
    rot: np.ndarray


@dataclass(frozen=True, eq=False)
class Packet:
    """One pose; metres, Z up, right-handed.

    Attributes:
        person: a name that stays the same as long as it is the same person.
        time_s: when the pose was, by the source's own clock.
        skeleton: its joints; the same object as long as it does not change.
        root_pos: `(3)` m, the root joint in the world.
        rot: `(J, 4)` wxyz, each joint's rotation in its parent's frame, the root's in the world.
        whole: a clip that shows how the skeleton stands, where there is one; else the first seconds do.
        places: `(B, 3)` m, where the character's bodies are to be, for policies that are told places
            alone; None where the pose tells all.
        tremble: what the person was found to do where this pose is smoothed, None where it came so.
        held_s: s for which the source has kept it back, to know it better.
        earlier: poses before it, as they are known now.
    """

    person: str
    time_s: float
    skeleton: Skeleton
    root_pos: np.ndarray
    rot: np.ndarray
    whole: Clip | None = None
    places: np.ndarray | None = None
    tremble: Tremble | None = None
    held_s: float = 0.0
    earlier: tuple[Earlier, ...] = ()


def checked(packet: Packet) -> Packet:
    """The packet with unit rotations.

    Raises:
        PoiseError: numbers that are not finite, rotations that are none, or a place beyond `FAR_M`.
    """
    if packet.root_pos.shape != (3,) or packet.rot.shape != (len(packet.skeleton), 4):
        raise PoiseError("shape", packet.person)
    if not np.isfinite(packet.time_s) or not np.isfinite(packet.root_pos).all():
        raise PoiseError("not finite", packet.person)
    norms = np.linalg.norm(packet.rot, axis=-1)
    if not np.isfinite(norms).all():
        raise PoiseError("not finite", packet.person)
    if norms.min() < 0.5 or norms.max() > 2.0:
        raise PoiseError("no rotation", packet.person)
    places = packet.places
    if places is not None and not np.isfinite(places).all():
        raise PoiseError("not finite", packet.person)
    if max(np.abs(x).max() for x in (packet.root_pos, places) if x is not None) > FAR_M:
        raise PoiseError("too far away", packet.person)
    if not 0 < len(packet.person) <= NAME:
        raise PoiseError("name", packet.person[:NAME])
    return replace(packet, rot=normalized(packet.rot))


class Smooths(Protocol):
    """What smooths the poses of one person, in the order in which they come."""

    skeleton: Skeleton

    @property
    def tremble(self) -> Tremble:
        """What the person does now."""
        ...

    def __call__(
        self, time_s: float, root: np.ndarray, rot: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The pose as it is known, None where a newer one came before it."""
        ...

    def before(self) -> list[Earlier]:
        """Those before it, from the latest on."""
        ...


class Inbox:
    """Packets on their way from the sources' threads to the loop; neither waits for the other.

    Args:
        steady: makes what smooths the poses of a skeleton, on the way in and in the source's thread;
            None lets them be.

    Attributes:
        received: packets that were taken.
        refused: how many were not, by the reason.
        crowded: packets that a newer one pushed out before the loop came.
        standing: people of keypoints that are measured yet, and how far that is, 0 to 1.
    """

    def __init__(self, steady: Callable[[Skeleton], Smooths] | None = None) -> None:
        self.received, self.crowded = 0, 0
        self.refused: Counter[str] = Counter()
        self.standing = dict[str, float]()
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[tuple[float, Packet]]] = {}
        self._make = steady
        self._steady: dict[str, Smooths] = {}

    def refuse(self, reason: str) -> None:
        """Counts something that is no packet."""
        with self._lock:
            self.refused[reason] += 1

    def offer(self, packet: Packet, arrived_s: float) -> bool:
        """Takes a packet that came at `arrived_s` by the loop's clock; False: it was refused."""
        try:
            good = self._smoothed(checked(packet))
        except PoiseError as problem:
            self.refuse(problem.what)
            return False
        with self._lock:
            line = self._waiting.get(good.person)
            if line is None:
                if len(self._waiting) >= PEOPLE:
                    self.refused["too many people"] += 1
                    return False
                line = self._waiting[good.person] = deque(maxlen=WAIT)
            self.crowded += len(line) == WAIT
            line.append((arrived_s, good))
            self.received += 1
        return True

    def _smoothed(self, packet: Packet) -> Packet:
        """The packet as its person is now known; one that comes late is left as it is."""
        if packet.tremble is not None or self._make is None:
            return packet
        with self._lock:
            steady = self._steady.pop(packet.person, None)
            if steady is None or steady.skeleton is not packet.skeleton:
                steady = self._make(packet.skeleton)
            # Those that were heard of last are the last.
            self._steady[packet.person] = steady
            while len(self._steady) > PEOPLE:
                del self._steady[next(iter(self._steady))]
        known = steady(packet.time_s, packet.root_pos, packet.rot)
        if known is None:
            return packet
        root, rot = known
        return replace(
            packet, root_pos=root, rot=rot, tremble=steady.tremble, earlier=tuple(steady.before())
        )

    def take(self) -> dict[str, list[tuple[float, Packet]]]:
        """All that wait, by person, each with the time at which it came."""
        with self._lock:
            out = {name: list(line) for name, line in self._waiting.items() if line}
            self._waiting.clear()
        return out
