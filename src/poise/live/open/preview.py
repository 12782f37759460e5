"""The frames that a job has simulated so far, in a file that the page reads while the job goes on."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from poise.body import Humanoid
from poise.jobs.track.placement import PlacedMotion
from poise.jobs.track.surroundings import places_home
from poise.kinematics import qpos_to_clip
from poise.live.open.look import figure_of, headed, places_of
from poise.motion import Clip

#: s between two times that states are written; bytes from which on only each second state is, or third.
EVERY_S, MOST_BYTES = 0.2, 24 << 20


class Preview:
    """Tells how far a job is, and writes what it has simulated.

    The file begins as `look.figure_of` does; the header's `frames` are those that are to come. Each row
    after it is a frame's number and the places `(J, 3)` of it, float32, m, in the world of the motion
    that came in. A frame may come again: the latest row holds.

    Args:
        show: is told how far the job is. path: the file.
    """

    def __init__(self, show: Callable[[str, int, int], None], path: Path):
        self._show, self._path = show, path
        self._rows, self._frames = list[np.ndarray](), list[int]()
        self._clip: Callable[[np.ndarray, np.ndarray], Clip] | None = None
        self._placed: PlacedMotion | None = None
        self._last, self._step = 0.0, 1

    def __call__(self, what: str, done: int, of: int) -> None:
        self._show(what, done, of)

    def begin(self, humanoid: Humanoid, placed: PlacedMotion, frames: int, rate_hz: float) -> None:
        """See `jobs.track.controllers.DrawsSteps`."""
        like = placed.clip

        def clip(qpos: np.ndarray, at: np.ndarray) -> Clip:
            # Joints that the body does not have move as in the motion.
            rows = np.minimum(np.rint(at / rate_hz * like.fps).astype(int), like.frames - 1)
            same = _part(like, rows)
            return qpos_to_clip(qpos, humanoid.table, like.skeleton, rate_hz, same)

        self._clip, self._placed = clip, placed
        first = figure_of(_part(like, np.arange(2)))
        size = int.from_bytes(first[:4], "little")
        header: dict[str, Any] = json.loads(first[4 : 4 + size])
        row = 4 * (1 + 3 * len(header["parents"]))
        self._step = math.ceil(frames * row / MOST_BYTES)
        scale = 1.0 / placed.moved.scale if placed.moved else 1.0
        header["radii"] = [r * scale for r in header["radii"]]
        header |= {"frames": frames, "fps": rate_hz, "step": 1, "head_m": header["head_m"] * scale}
        with contextlib.suppress(OSError):
            self._path.write_bytes(headed(header))

    def draw(self, frame: int, qpos: np.ndarray) -> None:
        """See `jobs.track.controllers.DrawsSteps`."""
        if frame % self._step:
            return
        self._rows.append(np.array(qpos))
        self._frames.append(frame)
        if time.monotonic() - self._last >= EVERY_S:
            self._write()

    def _write(self) -> None:
        if self._clip is None or self._placed is None:
            return
        # A motion has two frames at least.
        at = np.array([*self._frames, self._frames[-1]])
        clip = self._clip(np.stack([*self._rows, self._rows[-1]]), at)
        at, pos = at[:-1], places_home(places_of(clip)[:-1], self._placed)
        rows = np.concatenate((at[:, None], pos.reshape(len(pos), -1)), 1)
        # Without room on the disk nothing is drawn, and the job goes on.
        with contextlib.suppress(OSError), self._path.open("ab") as file:
            file.write(rows.astype("<f4").tobytes())
        self._rows, self._frames = [], []
        self._last = time.monotonic()


def _part(clip: Clip, rows: np.ndarray) -> Clip:
    """Some frames of a motion."""
    return Clip(clip.skeleton, clip.root_pos[rows], clip.rot[rows], clip.fps, clip.name)
