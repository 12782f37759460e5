"""A motion file played as a stream, again and again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from poise.live import quats as q
from poise.live.packet import Inbox, Packet
from poise.motion import Clip

#: s in which the end of a clip passes into its beginning.
FADE_S = 0.4


class Loop:
    """A clip without end: each time it begins where it ended, facing the same way."""

    def __init__(self, clip: Clip):
        self.clip = clip
        self.fade = min(round(FADE_S * clip.fps), (clip.frames - 1) // 2)
        self._length = clip.frames - self.fade
        # By how much each round is turned and moved against the one before.
        first, last = 0, clip.frames - self.fade if self.fade else clip.frames - 1
        self._turn = q.heading(clip.rot[last, 0]) - q.heading(clip.rot[first, 0])
        turn = q.yaw(self._turn)
        move = clip.root_pos[last] - q.rotate(turn, clip.root_pos[first])
        self._move = np.array([move[0], move[1], 0.0])

    def __call__(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Root `(3)` m and local rotations `(J, 4)` of frame 0, 1, 2, ..."""
        rounds, at = divmod(frame, self._length)
        root, rot = self._of(rounds, at)
        if rounds and at < self.fade:
            was, turned = self._of(rounds - 1, self._length + at)
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
