"""Doubts about a motion's frame rate, and motion in place: given its travel, written as it came."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from poise.env import Acts
from poise.errors import PoiseError
from poise.jobs.track.controllers import Show, StepProgress, look_ahead
from poise.jobs.track.direction import Direction
from poise.jobs.track.placement import PlacedMotion
from poise.jobs.tracker import Tracker
from poise.kinematics.loops import best_period, overlap_of, repeated
from poise.kinematics.rate import RateJudgement, usual_rate
from poise.kinematics.travel import Travel, find_travel, in_place, path_of, travelled
from poise.motion import Clip
from poise.plan import Lookahead
from poise.recipes.imitation import Imitation
from poise.score import ClipJudge, simulate

if TYPE_CHECKING:
    from poise.jobs.track.settings import Mode, TrackConfig


#: The rates that a lost motion is tried at, over its own, if files have them within `USUAL`.
TRIED, USUAL = (0.5, 2.0), 0.02


def rate_doubts(placed: Sequence[PlacedMotion]) -> list[str]:
    """Sentences on frame rates that physics speaks against, known before anything is simulated; of
    several motions each names its own."""
    out = []
    for p in placed:
        doubt = p.report.clips[0].rate.sentence()
        if doubt is not None:
            out.append(f"{p.clip.name}: {doubt}" if len(placed) > 1 else doubt)
    return out


def rate_notes(
    tracker: Tracker,
    given: Clip,
    judged: RateJudgement,
    on_body: Callable[[Clip], Imitation],
    config: TrackConfig,
    lost: bool,
    show: Show | None = None,
) -> list[str]:
    """Sentences on the frame rate at which a lost motion is done, none without any.

    A motion that more than the policy lost is tried at half and at double its rate, by the policy alone
    and then with lookahead if that is wanted; each try ends where it loses the motion. A policy that is
    alone loses much that it does when it is a little faster or slower: that says nothing. Where flights
    that fall with gravity vouch for the rate, nothing is tried. What was tracked stays as it is.

    Args:
        given: the motion as it was tracked. judged: what physics says of its rate.
        on_body: makes a task of a clip. lost: whether the motion was.
        show: is told of tries with lookahead.
    """
    notes = list[str]()
    single = (
        config.count == 1
        and config.controller != "policy"
        and not (config.recover or config.reset_on_fail or config.noise)
    )
    if lost and single and not judged.vouched:
        rate = _done_at(tracker, given, on_body, config, show)
        if rate is not None:
            notes.append(
                f"The motion was lost at its rate of {given.fps:.4g} Hz; played at {rate:.4g} Hz it is "
                f"done: is the frame rate right? If not, state it with --fps {rate:.4g}."
            )
    return notes


def _done_at(
    tracker: Tracker,
    given: Clip,
    on_body: Callable[[Clip], Imitation],
    config: TrackConfig,
    show: Show | None,
) -> float | None:
    """The first of the rates tried (Hz) at which the motion is done; None without any."""
    tasks: dict[float, Imitation] = {}
    for rate in (given.fps * x for x in TRIED):
        if abs(usual_rate(rate) / rate - 1.0) > USUAL:
            continue
        try:
            tasks[rate] = on_body(given.replaced(fps=rate))
        except PoiseError:
            # Too short, or too fast for a body.
            continue
    for rate, task in tasks.items():
        if _done(task, tracker.policy):
            return rate
    if not config.looks_ahead or tracker.value is None:
        return None
    for rate, task in tasks.items():
        ahead = look_ahead(tracker, task, config.lookahead, config.threads, config.seed)
        try:
            if _done(task, ahead, show, f"trying {rate:.4g} Hz"):
                return rate
        finally:
            ahead.copies.close()
    return None


def _done(task: Imitation, acts: Acts, show: Show | None = None, what: str = "") -> bool:
    """Whether a task's first motion is done to its end, without help."""
    last = task.reference.length[:1] - 1
    env, first = task.bare().env(1, None, False, 1, help_scale=0.0, guard=False), torch.zeros_like(last)
    judge = ClipJudge(last)
    told = () if show is None else (StepProgress(what, int(last), show),)
    try:
        if isinstance(acts, Lookahead):
            acts.watch(env)
        simulate(env, acts, env.reset_to(first, first), int(last), judge, *told)
    finally:
        env.close()
    return bool(judge.alive.all())


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
        """What was done, in words."""
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
