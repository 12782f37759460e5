"""A jitter buffer: poses that come at any rate, late, twice or never, read at even times."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from poise.live.packet import Earlier, Tremble
from poise.live.quats import slerp

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

NONE = Tremble()


def margin(delay_s: float) -> float:
    """s by which motion is read later than it comes, of a buffer of `delay_s`."""
    return min(delay_s, max(MARGIN_S, MARGIN * delay_s))


def leapt(before: np.ndarray, root_pos: np.ndarray, dt: float) -> bool:
    """Whether a root that was at `before (3)` m, `dt` s ago, did not move to `root_pos`."""
    far = float(np.linalg.norm(root_pos - before))
    return far > LEAP_M and far > JUMP * dt


class Pose(NamedTuple):
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
    """

    def __init__(self, delay_s: float = 0.1):
        self.delay_s, self.tremble = delay_s, Tremble()
        self.late = self.jumps = 0
        self._frames: deque[_Frame] = deque(maxlen=KEPT)
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
        tremble: Tremble = NONE,
        held_s: float = 0.0,
        earlier: Sequence[Earlier] = (),
    ) -> None:
        """One more packet; one that is older than the newest is left out. The rest: see `Packet`."""
        way = arrived_s - time_s - held_s
        self._ways.append(way)
        self._way = min(self._ways)
        self._arrived = max(self._arrived, arrived_s)
        frames = self._frames
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

    def read(self, now_s: float) -> Pose | None:
        """The pose at `now_s` by the loop's clock; None before anything has come."""
        frames = self._frames
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
            return Pose(a.root_pos, a.rot, stale, jumped, a.places, stalled)
        places = None
        if a.places is not None and b.places is not None:
            places = a.places + share * (b.places - a.places)
        root = a.root_pos + share * (b.root_pos - a.root_pos)
        return Pose(root, slerp(a.rot, b.rot, share), stale, jumped, places, stalled)

    def _kept_back(self, now_s: float) -> float:
        """s, that of the tremble; it comes and goes gently."""
        most = np.inf if self._now is None else KEEPS_BACK * max(0.0, now_s - self._now)
        self._now = now_s
        self._late += float(np.clip(self.tremble.late_s - self._late, -most, most))
        return self._late

    def _beyond(self, at: float) -> tuple[_Frame, _Frame, float]:
        """The last two frames and a share of the way between them, beyond 1: q_0 + v_0 tau
        (1 - e^(-t / tau)), where the motion goes on, and comes to rest."""
        last = self._frames[-1]
        if len(self._frames) < 2 or last.leaps:
            return last, last, 0.0
        before = self._frames[-2]
        dt = max(last.time_s - before.time_s, 1e-3)
        if dt > 0.25:
            return last, last, 0.0
        share = FADE_S * (1.0 - np.exp(-(at - last.time_s) / FADE_S)) / dt
        return before, last, 1.0 + share
