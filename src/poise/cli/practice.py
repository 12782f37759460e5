"""`poise imitate` from a policy: a first result by lookahead, then the policy learns the clip."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from poise.cli.answer import Answer
from poise.cli.console import notes, print_card, say, tell
from poise.cli.progress import clock, left, showing, working
from poise.cli.track import follow, outcome
from poise.cli.training import Job, held_already, stopped
from poise.errors import PoiseError
from poise.jobs.keep import claimed

if TYPE_CHECKING:
    from poise.jobs.perpetual.stage_order import Progress
    from poise.jobs.track import Tracked
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
    from poise.jobs.imitate import STARTS
    from poise.jobs.open import open_run
    from poise.jobs.run_file import RUN_FILE, learning_curve
    from poise.jobs.track import write
    from poise.jobs.track.in_place import with_travel
    from poise.jobs.track.learning import from_every_start, learn
    from poise.jobs.track.placement import place
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
        first = None if held else first_result(job, tracker, clip, motion, hold)
        travel = first.travel if first else with_travel(clip, job.in_place)
        source = clip if travel is None else travel.clip
        if travel is not None and first is None:
            tell(travel.sentence(), "yellow")
        placed = first.placed if first else place(source, tracker)
        with showing("training") as bar:

            def show(p: Progress) -> None:
                spent = f"{clock(p.stats.seconds)}, {left(p.stats.seconds, p.share)} at most"
                bar(p.share, f"{spent}  {p.stats.samples_per_s:,.0f} samples/s")
                if p.results is not None:
                    share, off = 100 * p.results.tracked_share, p.results.error_mm
                    tell(f"{clock(p.stats.seconds)}  the policy tracks {share:.0f} %, {off:.0f} mm off")

            until = Until(minutes=t.minutes, iterations=t.iterations)
            where = (t.threads, job.config.seed, STARTS, t.device)
            try:
                learned, result = learn(tracker, placed, job.run, until, show, *where)
            except KeyboardInterrupt:
                # A second Ctrl-C ends the present iteration too; what is in the last checkpoint stays.
                return stopped(job.run, job.again)
        if result.interrupted:
            return stopped(job.run, job.again)
        with working("simulating every start frame"):
            tracked = replace(from_every_start(learned, source, t.device), travel=travel)
        if first is not None and tracked.failures and not first.failures:
            say("The policy still loses the motion from its first frame: what was found first stays.")
            say(again(job))
            card = tracked.card
            return Answer(card.to_dict(), {"run": job.run}, tracked.notes)
        done = write(tracked, job.out, motion, hold, learning_curve(job.run))
    print_card(done.card)
    if tracked.failures:
        say(f"{outcome(tracked, False)} {again(job)}")
    return Answer(done.card.to_dict(), {**done.paths, "run": job.run}, (*tracked.notes, *done.notes))


def first_result(job: Job, tracker: Tracker, clip: Clip, motion: Path | None, hold: bool) -> Tracked:
    """The motion by lookahead, or as it is searched, written before anything is learned."""
    from poise.jobs.track import TrackConfig, write

    config = TrackConfig(seed=job.config.seed, threads=job.training.threads, in_place=job.in_place)
    first = follow(tracker, [clip], config, [])
    paths = write(first, job.out, motion, hold).paths
    tell(f"First result: {outcome(first, False)} See {paths['report']}")
    return first


def again(job: Job) -> str:
    """What to do about a motion that was not learned in time."""
    minutes = f"--minutes {2 * job.training.minutes:g}"
    return f"Go on with --resume and {minutes}; or --from none learns it with help, which then goes."
