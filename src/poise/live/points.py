"""Keypoints of estimators as packets: people are measured while they stand, then fitted frame by frame.

The fit takes a few milliseconds a frame, in a thread of its own beside the loop; of frames that come
faster than the body is controlled the newest are fitted.
"""

from __future__ import annotations

import queue
import threading
from collections import deque

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.formats.point_fit import fit_clip
from poise.kinematics.retargeting.keypoint_goal import Gaps, PointBody
from poise.kinematics.stream_noise import FadingFilter, of_points
from poise.live.people import FEWEST, FORGET_S, STAND_S, STILL_M
from poise.live.sources import KeypointFrame
from poise.live.stream import PEOPLE, Inbox, Packet, StreamTremble
from poise.motion import Clip
from poise.motion.keypoints import Keypoints
from poise.motion.noise import hold_missing

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
            places = pos[0]
        else:
            root, rot = self._body.performer(whole[None])
        at, turned = root[0], rot[0]
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
