"""Sources of motion: files played as streams, JSON messages of a connection, keypoints of estimators.

People of keypoints are measured while they stand, then fitted frame by frame. The fit takes a few
milliseconds a frame, in a thread of its own beside the loop; of frames that come faster than the body is
controlled the newest are fitted.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.formats.point_fit import fit_clip
from poise.kinematics.retarget.keypoint_goal import Gaps, PointBody
from poise.kinematics.stream_noise import FadingFilter, of_points
from poise.live.people import FEWEST, FORGET_S, STAND_S, STILL_M
from poise.live.protocol import (
    JOINTS,
    name,
    number,
    numbers,
    parse,
    points_of,
    skeleton_of,
    turned,
    vertical,
)
from poise.live.stream import PEOPLE, Inbox, Packet, StreamTremble
from poise.motion import Clip, Skeleton
from poise.motion import quats as q
from poise.motion.keypoints import Keypoints
from poise.motion.noise import hold_missing

#: Takes a frame of keypoints; returns at once.
Takes = Callable[["KeypointFrame"], None]
#: s in which the end of a clip passes into its beginning.
FADE_S = 0.4
#: Share of a clip at either end in which it may pass over, and frames a second that are looked at.
SEAM, SEAM_HZ = 0.2, 30.0


class Loop:
    """A clip without end: each time it begins where it ended, facing the same way.

    It is played from its first frame on. From one near its end it passes over to one near its
    beginning, those two of them that are most alike, so that a walk goes on in step.
    """

    def __init__(self, clip: Clip):
        self.clip = clip
        self.fade = min(round(FADE_S * clip.fps), (clip.frames - 1) // 2)
        self._first, self._last = _seam(clip, self.fade)
        # By how much each round is turned and moved against the one before.
        self._turn = q.heading(clip.rot[self._last, 0]) - q.heading(clip.rot[self._first, 0])
        turn = q.yaw(self._turn)
        move = clip.root_pos[self._last] - q.rotate(turn, clip.root_pos[self._first])
        self._move = np.array([move[0], move[1], 0.0])

    def __call__(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Root `(3)` m and local rotations `(J, 4)` of frame 0, 1, 2, ..."""
        if frame < self._last:
            return self._of(0, frame)
        rounds, at = divmod(frame - self._last, max(1, self._last - self._first))
        root, rot = self._of(rounds + 1, self._first + at)
        if at < self.fade:
            was, turned = self._of(rounds, self._last + at)
            share = (at + 1) / (self.fade + 1)
            root = was + share * (root - was)
            rot = q.slerp(turned, rot, share)
        return root, rot

    def _of(self, rounds: int, at: int) -> tuple[np.ndarray, np.ndarray]:
        angle = self._turn * rounds
        root, rot = self.clip.root_pos[at], self.clip.rot[at].copy()
        rot[0] = q.mul(q.yaw(angle), rot[0])
        return q.rotate(q.yaw(angle), root) + self._moved(rounds), rot

    def _moved(self, rounds: int) -> np.ndarray:
        """sum over k < rounds of R^k m, for R the turn of one round."""
        if abs(self._turn) < 1e-9:
            return rounds * self._move
        # The geometric sum of complex numbers, (1 - z^n) / (1 - z).
        z = np.exp(1j * self._turn)
        m = complex(self._move[0], self._move[1]) * (1 - z**rounds) / (1 - z)
        return np.array([m.real, m.imag, 0.0])


def _seam(clip: Clip, fade: int) -> tuple[int, int]:
    """Frames of the first and of the last fifth of a clip that are most alike, in their poses, how these
    change and how high they are; `fade` frames follow the second."""
    end = clip.frames - fade if fade else clip.frames - 1
    step = max(1, round(clip.fps / SEAM_HZ))
    firsts = np.arange(0, max(1, int(SEAM * clip.frames)), step)
    lasts = np.arange(end, max(int((1 - SEAM) * clip.frames), int(firsts[-1]) + fade), -step)
    if not len(lasts):
        return 0, end

    def told(at: np.ndarray) -> np.ndarray:
        """Poses now and a tenth of a second later, without places and headings."""
        rows = list[np.ndarray]()
        for frame in np.concatenate((at, np.minimum(at + round(0.1 * clip.fps), clip.frames - 1))):
            rot = clip.rot[frame].copy()
            rot[0] = q.mul(q.yaw(-q.heading(rot[0])), rot[0])
            rot *= np.where(rot[:, :1] < 0, -1.0, 1.0)
            rows.append(np.append(rot, clip.root_pos[frame, 2]))
        return np.stack(rows).reshape(2, len(at), -1).swapaxes(0, 1).reshape(len(at), -1)

    apart = np.linalg.norm(told(firsts)[:, None] - told(lasts)[None], axis=-1)
    i, j = np.unravel_index(int(apart.argmin()), apart.shape)
    return int(firsts[i]), int(lasts[j])


class FileSource:
    """Plays clips into an inbox at their own rate, each as one person."""

    def __init__(self, clips: dict[str, Clip], inbox: Inbox, clock: Callable[[], float]):
        self.clips, self.inbox, self.clock = dict(clips), inbox, clock
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=self._play, args=(name, clip), daemon=True)
            for name, clip in clips.items()
        ]

    def start(self) -> None:
        """Begins to play."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stops."""
        self._stop.set()
        for thread in self._threads:
            thread.join(1.0)

    def _play(self, name: str, clip: Clip) -> None:
        loop, frame, began = Loop(clip), 0, time.perf_counter()
        while not self._stop.is_set():
            self.inbox.offer(packet_of(name, loop, frame), self.clock())
            frame += 1
            late = time.perf_counter() - began - frame / clip.fps
            if late > 1.0:
                # A machine that slept plays on from here.
                began += late
            self._stop.wait(max(0.0, -late))


def packet_of(name: str, loop: Loop, frame: int) -> Packet:
    """A frame of a clip that is played."""
    root, rot = loop(frame)
    return Packet(name, frame / loop.clip.fps, loop.clip.skeleton, root, rot, loop.clip)


class KeypointFrame(NamedTuple):
    """Keypoints `(K, 3)` m of a person, Z up, NaN where one is missing, and when they were and came."""

    person: str
    names: tuple[str, ...]
    points: np.ndarray
    time_s: float
    arrived_s: float


class JsonStream:
    """What one connection sends, see docs/live.md.

    Args:
        inbox: where packets go; what is refused is counted there.
        own: what is put before the names of people, so that connections keep apart.
        points: takes keypoints; None takes none.
    """

    def __init__(self, inbox: Inbox, own: str = "", points: Takes | None = None):
        self.inbox, self._own, self._points = inbox, own, points
        self._labels = dict[str, tuple[str, ...]]()
        self._skeletons: dict[str, tuple[Skeleton, str]] = {}

    def receive(self, text: str | bytes, arrived_s: float) -> str | None:
        """Takes a message; the reason, if it was refused."""
        try:
            self._take(parse(text), arrived_s)
        except PoiseError as problem:
            self.inbox.refuse(problem.what)
            return problem.what
        return None

    def _take(self, message: Mapping[str, Any], arrived_s: float) -> None:
        kind, person = message.get("type"), name(message.get("person", "person"))
        if kind == "skeleton":
            if person not in self._skeletons and len(self._skeletons) >= PEOPLE:
                raise PoiseError("too many people", "message", code="over-limit")
            self._skeletons[person] = skeleton_of(message), vertical(message)
            return
        if kind == "keypoints":
            self._keypoints(message, person, arrived_s)
            return
        if kind != "pose":
            raise PoiseError("unknown type", "message", code="unknown-message")
        if person not in self._skeletons:
            raise PoiseError("no skeleton yet", "message", code="skeleton-missing")
        skeleton, up = self._skeletons[person]
        time_s = number(message["time"]) if "time" in message else arrived_s
        root = numbers([message.get("root")], 3, 1)[0]
        rot = numbers(message.get("rotations"), 4, JOINTS)
        packet = Packet((self._own + person)[:64], time_s, skeleton, turned(root, up), turned(rot, up))
        self.inbox.offer(packet, arrived_s)

    def _keypoints(self, message: Mapping[str, Any], person: str, arrived_s: float) -> None:
        if self._points is None:
            raise PoiseError("no keypoints here", "message", code="no-keypoints")
        if "names" in message:
            if person not in self._labels and len(self._labels) >= PEOPLE:
                raise PoiseError("too many people", "message", code="over-limit")
            told = message["names"]
            if not isinstance(told, list) or not 0 < len(told) <= JOINTS:
                raise PoiseError("no names", "message", code="names-missing")
            labels = tuple(name(n) for n in told)
            if len(set(labels)) < len(labels):
                raise PoiseError("no names", "message", code="names-missing")
            self._labels[person] = labels
        labels = self._labels.get(person)
        if labels is None:
            raise PoiseError("no names yet", "message", code="names-missing")
        if "points" not in message:
            return
        points = points_of(message, len(labels))
        time_s = number(message["time"]) if "time" in message else arrived_s
        self._points(KeypointFrame((self._own + person)[:64], labels, points, time_s, arrived_s))


#: s between frames that are fitted at least, frames that wait, m/s beyond which a keypoint is missing.
APART_S, WAIT, MAX_SPEED = 0.024, 64, 25.0
#: s for which a missing keypoint travels along with the others; longer, and nothing is sent.
STALE_S = 0.5


class Performer:
    """One person of keypoints.

    Attributes:
        share: 0 to 1, how far the measuring is.
        arrived_s: when its last frame came.
    """

    def __init__(
        self, person: str, names: tuple[str, ...], onto: Clip, table: BodyTable, tells_places: bool
    ):
        self.person, self.names, self._onto, self._table = person, names, onto, table
        self._tells_places = tells_places
        self._seen = list[KeypointFrame]()
        self._body: PointBody | None = None
        self._whole: Clip | None = None
        self._time: float | None = None
        # Keypoints that were seen while the person stood; others are left out.
        self._kept = np.arange(len(names))
        self._gaps = Gaps(len(names), MAX_SPEED)
        self._steady: FadingFilter | None = None
        # When the last frames were, and which of them was fitted last.
        self._times, self._fitted = deque[float](maxlen=8), -np.inf
        self.share, self.arrived_s = 0.0, -np.inf

    def take(self, frame: KeypointFrame) -> Packet | None:
        """The packet of a frame, None while the person is measured or where too much is missing.

        Raises:
            PoiseError: keypoints that no body can be measured by.
        """
        before = self._time
        if before is not None and frame.time_s < before - 2.0:
            # A source that began anew.
            self._gaps, before, self._fitted = Gaps(len(self._kept), MAX_SPEED), None, -np.inf
        if before is not None and frame.time_s - before < APART_S:
            return None
        self._time = frame.time_s
        if self._body is None:
            self._measure(frame)
            return None
        dt = 0.0 if before is None else frame.time_s - before
        whole, stale = self._gaps(frame.points[self._kept], dt)
        if whole is None or stale > STALE_S:
            raise PoiseError("keypoints are missing", self.person, code="keypoints-unseen")
        assert self._whole is not None
        whole, time_s, tremble = self._smoothed(whole, frame.time_s, dt)
        if time_s <= self._fitted:
            return None
        self._fitted = time_s
        skeleton, places = self._whole.skeleton, None
        if self._tells_places:
            pos, root, rot = self._body.follow(whole[None])
            places = pos[0].numpy()
        else:
            root, rot = self._body.performer(whole[None])
        at, turned = root[0].numpy(), rot[0].numpy()
        held = tremble.late_s
        return Packet(self.person, time_s, skeleton, at, turned, self._whole, places, tremble, held)

    def _smoothed(
        self, whole: np.ndarray, time_s: float, dt: float
    ) -> tuple[np.ndarray, float, StreamTremble]:
        """Points `(K, 3)` of the newest frame that is known well, when it was, and how they tremble."""
        if self._steady is None:
            self._steady = of_points(len(whole))
        if not 0.0 < dt < 1.0:
            self._times.clear()
        self._times.appendleft(time_s)
        steady = self._steady
        known = [steady(whole.ravel(), dt), *steady.before()]
        # Of the frames that are known, the one that is kept back by most nearly as much.
        late = [time_s - t for t in list(self._times)[: len(known)]]
        k = int(np.abs(np.array(late) - steady.late_s).argmin())
        tremble = StreamTremble(steady.noise.mm, steady.noise.hz, late[k])
        return known[k].reshape(-1, 3), self._times[k], tremble

    def _measure(self, frame: KeypointFrame) -> None:
        seen = self._seen
        if np.isnan(frame.points).all():
            raise PoiseError("keypoints are missing", self.person, code="keypoints-unseen")
        if seen and np.isfinite(apart := _apart(frame.points, seen[0].points)) and apart > STILL_M:
            # A step begins it anew.
            seen.clear()
        seen.append(frame)
        long = frame.time_s - seen[0].time_s
        self.share = min(1.0, long / STAND_S)
        if long < STAND_S or len(seen) < FEWEST:
            return
        stood, self._seen, self.share = seen, [], 0.0
        every = np.stack([f.points for f in stood])
        kept = np.flatnonzero(np.isfinite(every).all(-1).mean(0) >= 0.5)
        if not len(kept):
            raise PoiseError("keypoints are missing", self.person, code="keypoints-unseen")
        names, rate = tuple(self.names[k] for k in kept), (len(stood) - 1) / long
        # The body is measured on frames without gaps.
        points = Keypoints(names, hold_missing(every[:, kept]), rate, self.person)
        try:
            body = PointBody.calibrate(points, self._onto, self._table)
            self._whole = fit_clip(points)
        except PoiseError as problem:
            raise PoiseError(
                "these keypoints show no body", self.person, code="no-body-shown"
            ) from problem
        self._body, self.share = body, 1.0
        self._kept, self._gaps, self._steady = kept, Gaps(len(kept), MAX_SPEED), None


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """m between two frames' points, the median."""
    far = np.linalg.norm(a - b, axis=-1)
    return float(np.median(far[np.isfinite(far)])) if np.isfinite(far).any() else np.nan


class PointFit:
    """Fits the people of all sources of keypoints, and puts packets into an inbox.

    Args:
        onto: a clip on the humanoid's skeleton, which shows how it stands.
        table: the humanoid's bodies.
        tells_places: whether packets also tell where the humanoid's bodies are by the keypoints alone,
            for a policy that is told no rotations.
    """

    def __init__(self, inbox: Inbox, onto: Clip, table: BodyTable, tells_places: bool = False):
        self.inbox, self._onto, self._table = inbox, onto, table
        self._tells_places = tells_places
        self._people = dict[str, Performer]()
        self._waiting: queue.Queue[KeypointFrame | None] = queue.Queue(WAIT)
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begins to fit."""
        self._thread.start()

    def close(self) -> None:
        """Stops."""
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join(2.0)

    def offer(self, frame: KeypointFrame) -> None:
        """Takes a frame; returns at once. Where too many wait it is left out."""
        try:
            self._waiting.put_nowait(frame)
        except queue.Full:
            self.inbox.refuse("too many keypoints")

    def fit(self, frame: KeypointFrame) -> None:
        """Fits a frame now."""
        known = self._people.get(frame.person)
        if known is None or known.names != frame.names:
            if known is None:
                self._forget(frame.arrived_s)
            if known is None and len(self._people) >= PEOPLE:
                self.inbox.refuse("too many people")
                return
            known = Performer(frame.person, frame.names, self._onto, self._table, self._tells_places)
            self._people[frame.person] = known
        known.arrived_s = frame.arrived_s
        try:
            packet = known.take(frame)
        except PoiseError as problem:
            self.inbox.refuse(problem.what)
            packet = None
        if known.share < 1.0:
            self.inbox.standing[frame.person] = known.share
        else:
            self.inbox.standing.pop(frame.person, None)
        if packet is not None:
            self.inbox.offer(packet, frame.arrived_s)

    def _forget(self, now_s: float) -> None:
        """Forgets people that have been away for long."""
        for gone in [n for n, p in self._people.items() if now_s - p.arrived_s > FORGET_S]:
            del self._people[gone]
            self.inbox.standing.pop(gone, None)

    def _run(self) -> None:
        while (frame := self._waiting.get()) is not None:
            self.fit(frame)
