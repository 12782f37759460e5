"""A clip in place: simulated with the travel that its feet tell, written as it came."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from poise.jobs.track.direction import Direction
from poise.kinematics.loops import best_period, overlap_of, repeated
from poise.kinematics.travel import Travel, find_travel, in_place, path_of, travelled
from poise.motion import Clip

if TYPE_CHECKING:
    from poise.jobs.track_settings import Mode

#: A loop is simulated for this long (s), as at least and at most so many periods.
LOOP_S, LEAST, MOST = 4.0, 4, 10


@dataclass(frozen=True, eq=False)
class InPlace:
    """A clip in place, and what is simulated for it.

    Attributes:
        source: as it came.
        travel: what was taken out of it.
        clip: with the travel; of a loop several periods, one after another.
        overlap: see `overlap_of`; None where one period is simulated.
        travels: whether the travel stays in what is written.
    """

    source: Clip
    travel: Travel
    clip: Clip
    overlap: int | None
    travels: bool

    @property
    def period(self) -> int:
        """Frames of one period of a loop."""
        return self.source.frames - (self.overlap or 0)

    def written(self, motion: Clip, scale: float = 1.0, lost_s: float | None = None) -> Clip:
        """A simulated motion of `clip` as it is written: one period of a loop, in place or travelling.

        scale: of the body in size to the skeleton that came in, about the root's first place. lost_s:
            when the character failed; of a loop a period before that is taken if there is one.
        """
        about = self.clip.root_pos[0, :2]
        travel = self.travel.scaled(scale, about)
        if self.overlap is None:
            return motion if self.travels else in_place(motion, travel)
        one = in_place(motion, travel)
        stop = None if lost_s is None else int(lost_s * motion.fps)
        one = best_period(one, self.period, self.overlap, stop=stop)
        return travelled(one, travel) if self.travels else one

    @property
    def beside(self) -> Clip:
        """The clip as what is written compares with it."""
        return travelled(self.source, self.travel) if self.travels else self.source

    def moved(self, direction: Direction) -> Direction:
        """A director's wishes, which were stated in the world of the clip, where it travels."""
        place, angle = path_of(self.travel, self.clip.frames, self.clip.fps)
        out = []
        for touch in direction.touches:
            k = min(touch.frame, len(angle) - 1)
            (x, y, z), c, s = touch.point, np.cos(angle[k]), np.sin(angle[k])
            there = np.array([c * x - s * y, s * x + c * y, z]) + place[k]
            out.append(replace(touch, point=tuple(float(v) for v in there)))
        return replace(direction, touches=tuple(out))

    def sentence(self) -> str:
        """The travel in words."""
        told = f"{self.source.name} {self.travel.words()}: it is simulated with that travel"
        one = ""
        if self.overlap is not None:
            count = (self.clip.frames - 1) // self.period
            told, one = f"{told} for {count} periods", ", the period that closes best"
        way = "with it" if self.travels else "in place again"
        return f"{told} and written {way}{one}; --in-place keep takes the file as it is."

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**self.travel.to_dict(), "loop": self.overlap is not None, "travels": self.travels}


def with_travel(
    clip: Clip, mode: Mode = "auto", *, repeats: bool = True, returns: bool = True
) -> InPlace | None:
    """A clip in place, with it; None where none was, or that is to be kept.

    Args:
        repeats: a loop is simulated as several periods.
        returns: the travel can be taken out again, since what is simulated keeps the clip's time.
    """
    if mode == "keep":
        return None
    overlap = overlap_of(clip)
    # From the last frame of a loop it goes on to the first.
    closed = clip if overlap is None else repeated(clip, overlap, 1)
    travel = find_travel(closed)
    if travel is None:
        return None
    travels = mode == "travel" or not returns
    if overlap is None or not repeats:
        return InPlace(clip, travel, travelled(clip, travel), None, travels)
    seconds = (closed.frames - 1) / clip.fps
    periods = int(np.clip(np.ceil(LOOP_S / seconds), LEAST, MOST))
    return InPlace(clip, travel, travelled(repeated(clip, overlap, periods), travel), overlap, travels)
