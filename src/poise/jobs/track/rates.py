"""Doubts about a motion's frame rate: by physics, and by trying others where it is lost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch

from poise.env import Acts
from poise.errors import PoiseError
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.track.controllers import Show, StepProgress, look_ahead
from poise.jobs.track.placement import PlacedMotion
from poise.jobs.tracker import Tracker
from poise.kinematics.rate import RateJudgement, usual_rate
from poise.motion import Clip
from poise.recipes.imitation import Imitation

if TYPE_CHECKING:
    from poise.jobs.track_settings import TrackConfig


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
    first = torch.zeros(1, dtype=torch.long)
    told = () if show is None else (StepProgress(what, int(task.reference.length[0]) - 1, show),)
    return bool(evaluate_clips(task, acts, first, 0.0, 1, observers=told).succeeded.all())
