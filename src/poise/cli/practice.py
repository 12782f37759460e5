"""`poise imitate` from a policy: a first result by lookahead, then the policy learns the clip, see
`jobs.practice`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from poise.cli.answer import LOST, Answer
from poise.cli.console import notes, print_card, say, tell
from poise.cli.progress import clock, left, showing, working
from poise.cli.track import follow
from poise.cli.training import Job, held_already, stopped
from poise.errors import PoiseError
from poise.jobs.keep import claimed

if TYPE_CHECKING:
    from poise.jobs.perpetual.stage_order import Progress
    from poise.jobs.track import TrackConfig, Tracked
    from poise.jobs.tracker import Tracker
    from poise.motion import Clip


def practise(job: Job, policy: str | None, motion: Path | None, hold: bool) -> Answer | None:
    """Tracks the clip, trains on it, simulates every start frame, writes the result.

    Args:
        policy: a file or a run; None for the policy that comes with Poise, if its joints fit the clip.
        motion: the file of the motion, in place of one in the folder. hold: standing feet are held.

    Returns:
        None where the policy does not fit, and the clip is to be learned from nothing.
    """
    from poise.jobs.open import open_run
    from poise.jobs.practice import Watching
    from poise.jobs.practice import practise as practised
    from poise.jobs.run_file import RUN_FILE, learning_curve
    from poise.jobs.track import write
    from poise.jobs.track.story import story
    from poise.learn import Until

    t, held = job.training, (job.run / RUN_FILE).exists()
    if held and not t.resume:
        raise held_already(job.out)
    clip = job.reading.read(job.clips[0])
    say(f"{clip.name}: {clip.seconds:.1f} s")
    notes(clip.skeleton.source.notes)
    with working("opening the policy"):
        tracker = open_run(policy).tracker
    try:
        tracker = tracker.with_bones_of(clip)
    except PoiseError as problem:
        if policy is not None:
            raise
        tell(f"It is learned from nothing, since the policy does not fit: {problem.what}.")
        return None
    with claimed(job.out):
        until, seed = Until(minutes=t.minutes, iterations=t.iterations), job.config.seed
        with Shown() as shown:
            first = First(job.out, motion, hold)
            told = Watching(shown.follow, first, lambda s: tell(s, "yellow"), shown.iteration)
            try:
                made = practised(
                    clip, tracker, job.run, until, seed, t.threads, t.device, told, True, job.in_place
                )
            except KeyboardInterrupt:
                # A second Ctrl-C ends the present iteration too; what is in the last checkpoint stays.
                return stopped(job.run, job.again)
        if made.tracked is None:
            return stopped(job.run, job.again)
        tracked = made.tracked
        done = write(tracked, job.out, motion, hold, learning_curve(job.run))
    print_card(done.card)
    became = story(tracked, hint=False)
    for sentence in (*(tracked.doubts if became.failed else ()), became.sentence, *made.sentences):
        say(sentence)
    if became.failed or done.card.help.force_mean_n:
        say(again(job))
    told = (*tracked.notes, *done.notes)
    code, said = (LOST, tracked.doubts) if became.failed else (0, ())
    return Answer(
        done.card.to_dict(), {**done.paths, "run": job.run}, told, code, became.word, said=said
    )


class First:
    """Writes what is done before anything is learned, and says so. motion, hold: see `practise`."""

    def __init__(self, out: Path, motion: Path | None, hold: bool):
        self.out, self.motion, self.hold = out, motion, hold

    def __call__(self, first: Tracked) -> None:
        from poise.jobs.track import write
        from poise.jobs.track.story import story

        done = write(first, self.out, self.motion, self.hold)
        tell(f"First result: {story(first, hint=False).sentence} See {done.paths['report']}")


class Shown:
    """What is shown while a motion is practised: one bar at a time."""

    def __init__(self) -> None:
        self._shown = contextlib.ExitStack()
        self._bar: Callable[[float, str], None] | None = None

    def __enter__(self) -> Shown:
        return self

    def __exit__(self, *problem: object) -> None:
        self._shown.close()

    def follow(self, policy: Tracker, clip: Clip, config: TrackConfig) -> Tracked:
        """Tracks, with bars of its own."""
        self._shown.close()
        self._bar = None
        return follow(policy, [clip], config, [])

    def iteration(self, p: Progress) -> None:
        """Shows one of the training."""
        if self._bar is None:
            self._bar = self._shown.enter_context(showing("training"))
        spent = f"{clock(p.stats.seconds)}, {left(p.stats.seconds, p.share)} at most"
        aid = f", with help of at most {p.help_n:.0f} N" if p.help_n else ""
        self._bar(p.share, f"{spent}  {p.stats.samples_per_s:,.0f} samples/s{aid}")
        if p.results is not None:
            share, off = 100 * p.results.tracked_share, p.results.error_mm
            tell(f"{clock(p.stats.seconds)}  the policy tracks {share:.0f} %, {off:.0f} mm off{aid}")


def again(job: Job) -> str:
    """What to do about a motion that was not learned in time."""
    return f"Go on with --resume and --minutes {2 * job.training.minutes:g}."
