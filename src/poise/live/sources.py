"""Sources of motion: files played as streams, and JSON messages of one connection."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from poise.errors import PoiseError
from poise.live.admission import parse
from poise.live.protocol import (
    JOINTS,
    name,
    number,
    numbers,
    points_of,
    skeleton_of,
    turned,
    vertical,
)
from poise.live.stream import PEOPLE, Inbox, Packet
from poise.motion import Clip, Skeleton
from poise.motion.rotations import ahead_angle, quat_mul, quat_rotate, slerp, yaw_quat

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

    Attributes:
        first, last: frames from which and to which each round after the first is played.
        fade: frames in which it passes over.
    """

    def __init__(self, clip: Clip):
        self.clip = clip
        self.fade = min(round(FADE_S * clip.fps), (clip.frames - 1) // 2)
        self.first, self.last = _seam(clip, self.fade)
        # By how much each round is turned and moved against the one before.
        self._turn = ahead_angle(clip.rot[self.last, 0]) - ahead_angle(clip.rot[self.first, 0])
        turn = yaw_quat(self._turn)
        move = clip.root_pos[self.last] - quat_rotate(turn, clip.root_pos[self.first])
        self._move = np.array([move[0], move[1], 0.0])

    def __call__(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Root `(3)` m and local rotations `(J, 4)` of frame 0, 1, 2, ..."""
        if frame < self.last:
            return self._of(0, frame)
        rounds, at = divmod(frame - self.last, max(1, self.last - self.first))
        root, rot = self._of(rounds + 1, self.first + at)
        if at < self.fade:
            was, turned = self._of(rounds, self.last + at)
            share = (at + 1) / (self.fade + 1)
            root = was + share * (root - was)
            rot = slerp(turned, rot, share)
        return root, rot

    def _of(self, rounds: int, at: int) -> tuple[np.ndarray, np.ndarray]:
        angle = self._turn * rounds
        root, rot = self.clip.root_pos[at], self.clip.rot[at].copy()
        rot[0] = quat_mul(yaw_quat(angle), rot[0])
        return quat_rotate(yaw_quat(angle), root) + self._moved(rounds), rot

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
            rot[0] = quat_mul(yaw_quat(-ahead_angle(rot[0])), rot[0])
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
