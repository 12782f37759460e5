"""One motion within minutes, by a policy that knows many: what it does at once, what it learns, and help
where neither finds the motion.

    made = practise(clip, tracker.with_bones_of(clip), folder, Until(minutes=5))
    made.tracked.card, made.sentences

1. The policy looks ahead, and a search looks for what is lost so (`Practised.first`).
2. It learns the motion. Where 1 lost it, a hand leads the root meanwhile (`plan.guide`), as strong as
   the policy needs to do the motion, and fades as it succeeds.
3. The policy alone is what is kept, if it does the motion; else the best of that, of lookahead and
   search with what it learned, and of 1 (`jobs.result.Merit`). Where all of them lose it, the motion
   with the least help is kept, which the score card and the sentences state.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from poise.errors import PoiseError
from poise.jobs.perpetual.stages import Progress
from poise.jobs.result import LOST, TRACKED, Result
from poise.jobs.run_file import RUN_FILE
from poise.jobs.track import TrackConfig, track
from poise.jobs.track.in_place import InPlace, with_travel
from poise.jobs.track.learning import (
    GRAVITY,
    SHARES,
    LearnedMotion,
    from_every_start,
    help_of,
    help_wanted,
    learn,
    with_help,
)
from poise.jobs.track.placement import place
from poise.jobs.track_settings import Mode
from poise.jobs.tracker import Tracker
from poise.jobs.warm_start import TrainingCallbacks
from poise.learn import IterationStats, Until
from poise.motion import Clip, ClipLibrary
from poise.recipes.imitation import Imitation

#: Start frames from which a motion is to be done before its training ends.
STARTS = 32
#: The share of the minutes that training has at least, whatever looking for the motion takes.
LEAST = 0.5


@dataclass(frozen=True)
class Watching:
    """Callbacks for what happens while a motion is imitated.

    Attributes:
        follow: tracks a motion, see `track`.
        first: is told of what was done before anything is learned.
        say: sentences, as they become known.
        iteration: each of the training on a motion; False ends it.
        doing: names what takes seconds, and surrounds it.
        given: the clips, once they are read.
        unfit: why the policy that comes with Poise does not fit, so that nothing begins.
        begun: the body, where it is learned from nothing.
        beginning: callbacks for what happens there before PPO begins.
        stats: each iteration there; False ends the training.
    """

    follow: Callable[[Tracker, Clip, TrackConfig], Result] = lambda t, c, how: track(c, t, how)
    first: Callable[[Result], None] = lambda _: None
    say: Callable[[str], None] = lambda _: None
    iteration: Callable[[Progress], bool | None] = lambda _: None
    doing: Callable[[str], AbstractContextManager[Any]] = lambda _: nullcontext()
    given: Callable[[ClipLibrary], None] = lambda _: None
    unfit: Callable[[PoiseError], None] = lambda _: None
    begun: Callable[[Imitation], None] = lambda _: None
    beginning: Callable[[Imitation], TrainingCallbacks | None] = lambda _: None
    stats: Callable[[IterationStats], bool | None] | None = None


class Practised(NamedTuple):
    """What came of it.

    Attributes:
        tracked: what is kept; None where Ctrl-C ended the training.
        learned: the policy as far as it came, and how its run ended.
        first: what was done before anything was learned; None where a run went on.
        sentences: what is to be said of it beside `story`.
    """

    tracked: Result | None
    learned: LearnedMotion
    first: Result | None
    sentences: tuple[str, ...] = ()


def practise(
    clip: Clip,
    tracker: Tracker,
    run: Path,
    until: Until,
    seed: int = 0,
    threads: int = 0,
    device: str = "cpu",
    watching: Watching | None = None,
    stop: bool = True,
    in_place: Mode = "auto",
) -> Practised:
    """Does what this module says.

    Args:
        tracker: on the bones of the clip.
        run: the folder of the run, which goes on if it is there.
        until: of all that comes before the last evaluation; training has half of the minutes at least.
        stop: a training that was interrupted is not evaluated.
        in_place: what becomes of a clip in place, see `track.in_place`.

    Raises:
        PoiseError: see `learn`.
    """
    told = watching or Watching()
    config = TrackConfig(seed=seed, threads=threads, in_place=in_place)
    began, first, newtons = time.monotonic(), None, 0.0
    if (run / RUN_FILE).exists():
        travel = with_travel(clip, in_place)
        if travel is not None:
            told.say(travel.sentence())
        placed, newtons = place(_moving(clip, travel), tracker), help_of(run)
    else:
        first = told.follow(tracker, clip, config)
        told.first(first)
        placed, travel = first.placed, first.travel
        if first.merit.ended != TRACKED:
            for doubt in first.doubts:
                told.say(doubt)
            newtons = _help(tracker, first, seed, threads, told.say)
        # What looks for the motion afterwards takes about as long.
        spent = 2.0 * (time.monotonic() - began) / 60.0
        if until.minutes is not None:
            until = replace(until, minutes=max(LEAST * until.minutes, until.minutes - spent))
    learned = learn(
        tracker, placed, run, until, told.iteration, threads, seed, STARTS, device, help_n=newtons
    )
    if learned.result.interrupted and stop:
        return Practised(None, learned, first)
    return _best(clip, tracker, learned, first, newtons, config, device, told, travel)


def _in_place(tracked: Result, travel: InPlace | None) -> Result:
    """The simulation of a clip in place, to be written as it came."""
    return tracked if travel is None else replace(tracked, travel=travel)


def _moving(clip: Clip, travel: InPlace | None) -> Clip:
    """The part of a clip that is simulated."""
    return clip if travel is None else travel.clip


def _help(tracker: Tracker, first: Result, seed: int, threads: int, say: Callable[[str], None]) -> float:
    """The help with which a motion that was lost is learned, N; 0 where none suffices."""
    newtons = help_wanted(tracker, first.placed, seed, threads)
    if newtons is None:
        say(
            f"Neither policy nor search finds the motion, and even a hand that leads the root with "
            f"{SHARES[-1]:g} times the body's weight does not lead the policy through it: it is learned "
            "without help."
        )
        return 0.0
    say(
        "Neither policy nor search finds the motion: while it is learned, a residual force of at first "
        f"up to {_newtons(newtons, tracker)} leads the root, and fades."
    )
    return newtons


def _newtons(newtons: float, tracker: Tracker) -> str:
    """Newtons, and how much of the body's weight they are."""
    share = newtons / (GRAVITY * tracker.humanoid.mass)
    return f"{newtons:.0f} N ({100 * share:.0f} % of body weight)"


def _best(
    clip: Clip,
    tracker: Tracker,
    learned: LearnedMotion,
    first: Result | None,
    newtons: float,
    config: TrackConfig,
    device: str,
    told: Watching,
    travel: InPlace | None,
) -> Practised:
    """The attempt that is kept, and why."""
    moving, said = _moving(clip, travel), list[str]()
    own = _in_place(from_every_start(learned.tracker, moving, device), travel)
    if newtons:
        said.append(
            f"A residual force of at first up to {_newtons(newtons, learned.tracker)} helped while it "
            "was learned."
        )
    if own.merit.ended == TRACKED:
        said += ["It has ended: nothing helps in what is written."] if newtons else []
        return Practised(own, learned, first, tuple(said))
    again = told.follow(learned.tracker, clip, config)
    kept = max(own, again, key=lambda t: t.merit)
    if first is None and kept.merit.ended != TRACKED:
        # A run that goes on is no reason to lose what had been found before it.
        first = told.follow(tracker, clip, config)
    if first is not None:
        kept = max(kept, first, key=lambda t: t.merit)
    aided = with_help(learned.tracker, moving, device) if newtons and kept.merit.ended == LOST else None
    if aided is not None and aided.merit > kept.merit:
        kept = _in_place(aided, travel)
        most = _newtons(float(aided.card.help.limit_n), tracker)
        said.append(f"Without help it is still lost; with up to {most} it is done.")
    elif newtons:
        said.append("It has ended: nothing helps in what is written.")
    if kept is first:
        said.append("The policy did not learn to do it better: what was found first is kept.")
    elif kept is again:
        how = "search" if again.controller == "search" else "lookahead"
        said.append(f"The policy alone still loses the motion: what {how} does with it is kept.")
    return Practised(kept, learned, first, tuple(said))
