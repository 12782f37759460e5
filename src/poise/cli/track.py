"""`poise track`: a motion in, the same motion done by a trained policy out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from poise.cli.console import notes, say, tell
from poise.cli.options import Reading
from poise.cli.output import claimed
from poise.cli.progress import clock, showing, working
from poise.cli.results import print_card
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.jobs.perpetual.progress import Progress
    from poise.jobs.track import TrackConfig, Tracked
    from poise.jobs.track.policy import Tracker
    from poise.motion import Clip
    from poise.motion.keypoints import Keypoints
    from poise.plan import SamplingConfig

#: Failures that are named one by one.
NAMED = 8


@dataclass(frozen=True)
class Options:
    """Let a trained policy do a motion that it need not know, without help and without training: write
    the motion, score.json and report.html. For a motion that it loses it can --search, or --learn it."""

    clip: Annotated[Positional[Path], arg(metavar="FILE")]
    """The motion file: a clip of any human skeleton, or keypoints."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR|FILE")]
    """The folder of the results; or the file of the motion (.bvh, .glb, .npz, ...), and the rest goes
    into a folder of its name."""
    policy: Annotated[Path | None, arg(metavar="FILE|RUN", help_behavior_hint="")] = None
    """A policy file, or the folder of a run of poise train perpetual; by default the one that comes with
    Poise."""
    search: bool = False
    """If the policy loses the motion, look for it: many characters try at once, those that come near it
    go on. What is found is one simulation, without help; it takes seconds for each of the motion."""
    characters: Annotated[int, arg(metavar="N")] = 512
    """Characters that --search at once; more find harder motions."""
    rounds: Annotated[int, arg(metavar="N")] = 1
    """How often it is searched; later rounds stay about what was found, and come nearer."""
    learn: Annotated[float, arg(metavar="MINUTES")] = 0.0
    """If the policy loses the motion, train it on that motion first, for so many minutes at most. What
    it learned is kept in learned/ of the folder; the same command goes on where it was stopped."""
    threads: Annotated[int, arg(metavar="N")] = 0
    """Cores for --search and --learn; 0 is all."""
    reset_on_fail: bool = False
    """Put a character that is 0.5 m off back onto the motion, and go on."""
    recover: bool = False
    """A character that is 0.5 m off gets up, walks back and goes on where the motion waits for it."""
    count: Annotated[int, arg(metavar="N")] = 1
    """Characters who do the motion side by side in one world, where they may collide."""
    noise: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KIND:STRENGTH")] = ()
    """Errors of a pose estimator on the input, such as jitter:1 or video:0.5."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of the noise, and of what --search and --learn draw."""
    hold_feet: bool = True
    """In the written motion standing feet are held to the spot; so they stay as simulated."""
    save_policy: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write the policy as one file (.safetensors), which starts faster than a run folder."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options, argv: Sequence[str]) -> int:
    """Opens the policy, reads, tracks, writes; says where the character failed."""
    o = options
    if not 1 <= o.count <= 64:
        raise PoiseError(f"--count must lie in 1 to 64, got {o.count}")
    if not 0 <= o.seed < 2**31:
        raise PoiseError(f"--seed must be a whole number of at least 0, got {o.seed}")
    if not 0 <= o.learn <= 100_000:
        raise PoiseError(f"--learn needs minutes of at least 0, got {o.learn:g}")
    if o.learn and o.noise:
        what = "--learn learns the motion without errors, and --noise adds some"
        raise PoiseError(what, hint="Leave one out")
    if not 8 <= o.characters <= 65_536:
        raise PoiseError(f"--characters must lie in 8 to 65536, got {o.characters}")
    if not 1 <= o.rounds <= 20:
        raise PoiseError(f"--rounds must lie in 1 to 20, got {o.rounds}")
    if o.threads < 0:
        raise PoiseError(f"--threads must be at least 0, got {o.threads}")
    out, motion = places(o.clip, o.out)
    if motion is not None and o.count > 1:
        raise PoiseError("several characters make several files", motion, "Give a folder as -o")
    from poise.jobs.open import open_run
    from poise.jobs.track import TrackConfig, track, write
    from poise.jobs.track.noise import noise_of
    from poise.jobs.track.policy import save_tracker

    noise = noise_of(o.noise)
    given = read(o.clip, o.reading)
    with working("opening the policy"):
        tracker = open_run(o.policy).tracker
    config = TrackConfig(noise, o.seed, o.reset_on_fail, o.recover, o.reading.smooth, o.count)
    config = replace(config, search=searches(o), search_threads=o.threads)
    with claimed(out):
        with working("tracking"):
            # What is to be learned is the motion alone.
            plain = replace(config, recover=o.recover and not o.learn, search=None)
            tracked = track(tracker, given, plain)
        if o.learn and tracked.failures:
            if (learned := practise(o, tracker, tracked, out / "learned")) is None:
                return 130
            tracker = learned
            tracked = track(tracker, given, replace(config, search=None))
        if o.search and tracked.failures:
            tracked = look(tracker, given, config)
        with working("writing"):
            done = write(tracked, out, motion, o.hold_feet)
            if o.save_policy is not None:
                save_tracker(tracked.tracker, o.save_policy)
    print_card(done.card)
    notes((*tracked.notes, *done.notes))
    say(outcome(tracked, o.reset_on_fail))
    if tracked.failures:
        say(advice(o))
    for path in (*done.paths.values(), *((o.save_policy,) if o.save_policy else ())):
        say(str(path))
    return 0


def searches(options: Options) -> SamplingConfig | None:
    """How a motion is looked for, if it is."""
    from poise.plan import SamplingConfig

    o = options
    return SamplingConfig(o.characters, rounds=o.rounds, seed=o.seed) if o.search else None


def look(tracker: Tracker, given: Clip | Keypoints, config: TrackConfig) -> Tracked:
    """The motion as it is found by a search."""
    from poise.jobs.track import track

    began = time.monotonic()
    with showing("searching") as bar:

        def show(done: int, steps: int) -> None:
            share, spent = done / steps, time.monotonic() - began
            left = f", {clock(spent * (1 / share - 1))} left" if share else ""
            bar(share, f"{100 * share:.0f} % searched{left}")

        return track(tracker, given, config, show)


def practise(options: Options, tracker: Tracker, tracked: Tracked, folder: Path) -> Tracker | None:
    """The policy after it has learned the motion; None where Ctrl-C ended that."""
    from poise.cli.perpetual_shown import times
    from poise.jobs.track.learning import learn

    o, when, rate = options, tracked.failures[0][1], tracker.config.sim.control_hz
    tell(f"The policy loses the motion at {when:.1f} s and learns it now, {o.learn:g} minutes at most.")
    with showing("learning") as bar:

        def show(p: Progress) -> None:
            bar(p.share, f"{times(p)}  {p.stats.samples_per_s:,.0f} samples/s")
            if p.results is not None:
                came, whole = (float(x) / rate for x in (p.results.tracked, p.results.frames))
                tell(f"{clock(p.stats.seconds)}  it gets to {came:.1f} of {whole:.1f} s")

        learned = learn(tracker, tracked.placed, folder, o.learn, show, o.threads, o.seed)
    if learned.result.interrupted:
        tell("Stopped; what was learned is saved. The same command goes on.")
        return None
    if learned.result.last is not None:
        stats = learned.result.last.stats
        tell(f"Learned {clock(stats.seconds)}, {stats.samples:,} samples.")
    return learned.tracker


def advice(options: Options) -> str:
    """What to do about a motion that was lost."""
    o = options
    learns = "with --learn 10 the policy first learns this motion, for 10 minutes at most."
    if o.learn:
        return f"The same command with more minutes goes on learning: --learn {2 * o.learn:g}."
    if o.search:
        return f"Try --characters {2 * o.characters}; or {learns}"
    return f"With --search many characters look for it; {learns}" if o.count == 1 else "W" + learns[1:]


def outcome(tracked: Tracked, reset: bool) -> str:
    """Where the character failed, in one sentence."""
    reference, times = tracked.imitation.reference, tracked.failed_s
    seconds = (int(reference.length[0]) - 1) / reference.rate_hz
    count, fell = len(reference.length), {who for who, _ in tracked.failures}
    if count > 1:
        first = f", the first at {tracked.failures[0][1]:.1f} s" if fell else ""
        again = f"; they were put back {len(tracked.failures)} times" if fell and reset else ""
        return f"{count - len(fell)} of {count} characters tracked all {seconds:.1f} s{first}{again}."
    if tracked.losses is not None:
        return tracked.losses.sentence()
    if not times and tracked.found is not None:
        return f"Found to its end, {seconds:.1f} s, without help; the policy alone loses it."
    if not times:
        return f"Tracked to its end, {seconds:.1f} s, without help."
    if not reset:
        return (
            f"The character failed at {times[0]:.1f} s of {seconds:.1f} s, where it was 0.5 m off; "
            "what follows is not tracking. --reset-on-fail puts it back and goes on."
        )
    named = ", ".join(f"{t:.1f}" for t in times[:NAMED]) + (", ..." if len(times) > NAMED else "")
    return (
        f"The character failed {len(times)} times in {seconds:.1f} s and was put back, at {named} s; "
        "the score ends at the first failure."
    )


def read(path: Path, reading: Reading) -> Clip | Keypoints:
    """The motion in a file; keypoints stay keypoints."""
    from poise.jobs.track.points import points_of
    from poise.motion.io.raw import Options as Stated

    clip = reading.read(path)
    if reading.ground is not None or reading.swap_sides:
        # What was stated about the skeleton is known to the clip alone.
        return clip
    stated = Stated(fps=reading.fps, unit_m=reading.unit, up_axis=reading.up)
    return points_of(clip, stated) or clip


def places(clip: Path, out: Path) -> tuple[Path, Path | None]:
    """The folder of the results, and the file of the motion where one was named."""
    if not out.suffix or out.is_dir():
        return out, None
    from poise.motion.io import check_writable

    check_writable(out)
    if out.exists() and clip.exists() and out.samefile(clip):
        raise PoiseError("the motion would be written over itself", out, "Give -o another name")
    return out.with_suffix(""), out
