"""What a source sends, one pose of one person at one time, and a jitter buffer that reads them at even
times: they come at any rate, late, twice or never.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from poise.errors import PoiseError
from poise.motion import Clip, Skeleton
from poise.motion.rotations import normalize, slerp

#: Packets of one person that wait at most; the newest win.
WAIT = 64
#: People of all sources together.
PEOPLE = 32
#: m from the origin beyond which nothing is believed.
FAR_M = 1000.0
#: Letters of a person's name.
NAME = 64


class StreamTremble(NamedTuple):
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
    tremble: StreamTremble | None = None
    held_s: float = 0.0
    earlier: tuple[Earlier, ...] = ()


def checked(packet: Packet) -> Packet:
    """The packet with unit rotations.

    Raises:
        PoiseError: numbers that are not finite, rotations that are none, or a place beyond `FAR_M`.
    """
    if packet.root_pos.shape != (3,) or packet.rot.shape != (len(packet.skeleton), 4):
        raise PoiseError("shape", packet.person, code="wrong-shape")
    if not np.isfinite(packet.time_s) or not np.isfinite(packet.root_pos).all():
        raise PoiseError("not finite", packet.person, code="not-finite")
    norms = np.linalg.norm(packet.rot, axis=-1)
    if not np.isfinite(norms).all():
        raise PoiseError("not finite", packet.person, code="not-finite")
    if norms.min() < 0.5 or norms.max() > 2.0:
        raise PoiseError("no rotation", packet.person, code="not-a-rotation")
    places = packet.places
    if places is not None and not np.isfinite(places).all():
        raise PoiseError("not finite", packet.person, code="not-finite")
    if max(np.abs(x).max() for x in (packet.root_pos, places) if x is not None) > FAR_M:
        raise PoiseError("too far away", packet.person, code="too-far")
    if not 0 < len(packet.person) <= NAME:
        raise PoiseError("name", packet.person[:NAME], code="not-a-name")
    return replace(packet, rot=normalize(packet.rot))


class Smooths(Protocol):
    """What smooths the poses of one person, in the order in which they come."""

    skeleton: Skeleton

    @property
    def tremble(self) -> StreamTremble:
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


#: s of the buffer that even out how packets come at least, and share of it that does where that is more;
#: the rest may be looked ahead at.
MARGIN_S, MARGIN = 0.05, 0.5
#: s in which motion that has stopped coming comes to rest: its velocity falls by e in each.
FADE_S = 0.1
#: s without a new pose after which motion is known to have stopped coming.
STALLS_S = 0.2
#: s a second by which motion that begins to tremble is kept back more and more.
KEEPS_BACK = 0.15
#: m/s and m beyond which a person did not move but is elsewhere, or is another one.
JUMP, LEAP_M = 12.0, 0.4
#: Packets by which the way's shortest time is known, and those that are kept.
SEEN, KEPT = 240, 320

NONE = StreamTremble()


def margin(delay_s: float) -> float:
    """s by which motion is read later than it comes, of a buffer of `delay_s`."""
    return min(delay_s, max(MARGIN_S, MARGIN * delay_s))


def leapt(before: np.ndarray, root_pos: np.ndarray, dt: float) -> bool:
    """Whether a root that was at `before (3)` m, `dt` s ago, did not move to `root_pos`."""
    far = float(np.linalg.norm(root_pos - before))
    return far > LEAP_M and far > JUMP * dt


class StreamPose(NamedTuple):
    """A pose that was read.

    Attributes:
        root_pos: `(3)` m.
        rot: `(J, 4)` wxyz, local.
        stale_s: for how long nothing has come.
        jumped: whether the person is elsewhere since the pose that was read before.
        places: `(B, 3)` m of the character's bodies, where the source tells them.
        stalled: whether it is extrapolated by more than `STALLS_S`.
    """

    root_pos: np.ndarray
    rot: np.ndarray
    stale_s: float
    jumped: bool
    places: np.ndarray | None = None
    stalled: bool = False


class _Frame(NamedTuple):
    time_s: float
    root_pos: np.ndarray
    rot: np.ndarray
    leaps: bool
    places: np.ndarray | None


class JitterBuffer:
    """The poses of one person.

    A source's clock is its own; the shortest way that a packet took is when it was made. What is read at
    `now` is as it was `margin(delay_s)` before, so that with no delay at all motion is
    extrapolated, and with one it is between two packets. Motion that trembles is read `tremble.late_s`
    later, and smoothed by what has come meanwhile.

    Args:
        delay_s: s, 0 to 0.4; by what of it exceeds the margin, a goal lags behind what is read here.

    Attributes:
        tremble: what the person does now.
        frames: the poses that are kept, the newest last.
    """

    def __init__(self, delay_s: float = 0.1):
        self.delay_s, self.tremble = delay_s, StreamTremble()
        self.late = self.jumps = 0
        self.frames: deque[_Frame] = deque(maxlen=KEPT)
        self._ways: deque[float] = deque(maxlen=SEEN)
        self._way = 0.0
        self._arrived = -np.inf
        # The moment that was read last, when that was, and by how much motion is kept back.
        self._read = -np.inf
        self._now: float | None = None
        self._late = 0.0

    def add(
        self,
        time_s: float,
        arrived_s: float,
        root_pos: np.ndarray,
        rot: np.ndarray,
        places: np.ndarray | None = None,
        tremble: StreamTremble = NONE,
        held_s: float = 0.0,
        earlier: Sequence[Earlier] = (),
    ) -> None:
        """One more packet; one that is older than the newest is left out. The rest: see `Packet`."""
        way = arrived_s - time_s - held_s
        self._ways.append(way)
        self._way = min(self._ways)
        self._arrived = max(self._arrived, arrived_s)
        frames = self.frames
        if frames and time_s < frames[-1].time_s - 2.0:
            # A source that began anew.
            frames.clear()
            self._ways.clear()
            self._ways.append(way)
            self._way = way
            self._read = -np.inf
        if frames and time_s <= frames[-1].time_s:
            self.late += 1
            return
        leaps = False
        if frames:
            leaps = leapt(frames[-1].root_pos, root_pos, time_s - frames[-1].time_s)
            self.jumps += leaps
            for when, root, turned in earlier:
                k = next((k for k in range(1, len(frames) + 1) if frames[-k].time_s <= when), 1)
                if frames[-k].time_s == when:
                    frames[-k] = frames[-k]._replace(root_pos=root, rot=turned)
        self.tremble = tremble
        frames.append(_Frame(time_s, root_pos, rot, leaps, places))

    def read(self, now_s: float) -> StreamPose | None:
        """The pose at `now_s` by the loop's clock; None before anything has come."""
        frames = self.frames
        if not frames:
            return None
        at = now_s - self._way - margin(self.delay_s) - self._kept_back(now_s)
        # A leap is told when it is read, which is later than it comes.
        jumped = any(f.leaps and self._read < f.time_s <= at for f in frames)
        self._read = max(self._read, at)
        stale = max(0.0, now_s - self._arrived)
        stalled = at - frames[-1].time_s > STALLS_S
        after = next((k for k in range(len(frames) - 1, -1, -1) if frames[k].time_s <= at), -1)
        if after == len(frames) - 1:
            a, b, share = self._beyond(at)
        elif after < 0:
            a, b, share = frames[0], frames[0], 0.0
        else:
            a, b = frames[after], frames[after + 1]
            share = 0.0 if b.leaps else (at - a.time_s) / (b.time_s - a.time_s)
        if share == 0.0:
            return StreamPose(a.root_pos, a.rot, stale, jumped, a.places, stalled)
        places = None
        if a.places is not None and b.places is not None:
            places = a.places + share * (b.places - a.places)
        root = a.root_pos + share * (b.root_pos - a.root_pos)
        return StreamPose(root, slerp(a.rot, b.rot, share), stale, jumped, places, stalled)

    def _kept_back(self, now_s: float) -> float:
        """s, that of the tremble; it comes and goes gently."""
        most = np.inf if self._now is None else KEEPS_BACK * max(0.0, now_s - self._now)
        self._now = now_s
        self._late += float(np.clip(self.tremble.late_s - self._late, -most, most))
        return self._late

    def _beyond(self, at: float) -> tuple[_Frame, _Frame, float]:
        """The last two frames and a share of the way between them, beyond 1: q_0 + v_0 tau
        (1 - e^(-t / tau)), where the motion goes on, and comes to rest."""
        last = self.frames[-1]
        if len(self.frames) < 2 or last.leaps:
            return last, last, 0.0
        before = self.frames[-2]
        dt = max(last.time_s - before.time_s, 1e-3)
        if dt > 0.25:
            return last, last, 0.0
        share = FADE_S * (1.0 - np.exp(-(at - last.time_s) / FADE_S)) / dt
        return before, last, 1.0 + share
