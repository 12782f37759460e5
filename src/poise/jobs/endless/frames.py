"""Frames of motion without end: kept in a file, not in memory, and given on in pieces."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Callable

import numpy as np

from poise.body import BodyTable
from poise.kin import hold_feet, qpos_to_clip
from poise.motion import Clip

#: Frames of a piece, and how many of them two pieces share.
PIECE, SHARED = 300, 30


class FrameStore:
    """Rows of coordinates `(7 + n)`, appended one by one to an unnamed temporary file as float32."""

    def __init__(self, width: int):
        self.width, self.count = width, 0
        self._file = tempfile.TemporaryFile(prefix="poise-")  # noqa: SIM115 - it lives as long as this.
        weakref.finalize(self, self._file.close)

    def append(self, row: np.ndarray) -> None:
        """One more row `(7 + n)`."""
        self._file.seek(0, 2)
        self._file.write(np.asarray(row, np.float32).tobytes())
        self.count += 1

    def read(self, first: int = 0, last: int | None = None) -> np.ndarray:
        """Rows `first` to before `last` (by default all), `(T, 7 + n)` float64."""
        last = self.count if last is None else min(last, self.count)
        first = min(first, last)
        self._file.seek(4 * self.width * first)
        data = self._file.read(4 * self.width * (last - first))
        return np.frombuffer(data, np.float32).reshape(-1, self.width).astype(np.float64)


class Body:
    """Turns coordinates into clips on a body's skeleton; joints without hinges stay as in `example`."""

    def __init__(self, table: BodyTable, example: Clip, fps: float):
        self.table, self.example, self.fps = table, example, fps

    def clip(self, qpos: np.ndarray, name: str) -> Clip:
        """The clip of coordinates `(T, 7 + n)`."""
        rot = self.example.rot[:1].repeat(len(qpos), 0)
        like = self.example.replaced(
            root_pos=qpos[:, :3].copy(), rot=rot, fps=self.fps, name=name, cyclic=False
        )
        return qpos_to_clip(qpos, self.table, self.example.skeleton, self.fps, like, name)


class Pieces:
    """Gives motion on in clips of about ten seconds, its standing feet held in place.

    Feet are held in windows of `PIECE + SHARED` frames; where two of them meet, the one passes into the
    other over `SHARED` frames, so that nothing jumps.

    Args:
        store: the frames that are there so far.
        give: gets each clip once, in order.
        hold: whether standing feet are held at all.
    """

    def __init__(
        self, store: FrameStore, body: Body, give: Callable[[Clip], None], name: str, hold: bool = True
    ):
        self.store, self.body, self.give, self.name, self.hold = store, body, give, name, hold
        self._given = 0
        self._before: Clip | None = None

    def more(self) -> None:
        """Gives on what is whole; to be called after each frame."""
        while self.store.count >= self._given + PIECE + SHARED:
            self._give(self._given + PIECE + SHARED, PIECE)

    def finish(self) -> None:
        """Gives on what is left."""
        left = self.store.count - self._given
        if left > 0:
            self._give(self.store.count, left)

    def _give(self, last: int, count: int) -> None:
        clip = self.body.clip(self.store.read(self._given, last), self.name)
        if self.hold:
            clip = hold_feet(clip, self.body.table)[0]
        if self._before is not None:
            clip = faded(self._before, clip)
        self._before = _part(clip, count, clip.frames) if clip.frames > count else None
        self.give(_part(clip, 0, count))
        self._given += count


def faded(before: Clip, after: Clip) -> Clip:
    """`after`, with its first frames passing over from `before`, which are the same moments."""
    n = min(before.frames, after.frames)
    t = (np.arange(n) + 0.5) / n
    share = (t * t * (3 - 2 * t))[:, None, None]
    old, new = before.rot[:n], after.rot[:n]
    sign = np.where((old * new).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    mixed = (1 - share) * sign * old + share * new
    rot = after.rot.copy()
    rot[:n] = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
    return after.replaced(rot=rot)


def _part(clip: Clip, first: int, last: int) -> Clip:
    return clip.replaced(root_pos=clip.root_pos[first:last], rot=clip.rot[first:last])
