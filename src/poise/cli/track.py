"""`poise track`: a motion in, the same motion done by a trained policy out, without any training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from poise.cli.console import notes, say
from poise.cli.options import Reading
from poise.cli.output import claimed
from poise.cli.progress import working
from poise.cli.results import print_card
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.motion import Clip
    from poise.motion.keypoints import Keypoints
    from poise.recipes.track import Tracked

#: Failures that are named one by one.
NAMED = 8


@dataclass(frozen=True)
class Options:
    """Let a trained policy do a motion that it need not know, without training and without help: write
    the motion, score.json and report.html."""

    clip: Annotated[Positional[Path], arg(metavar="FILE")]
    """The motion file: a clip of any human skeleton, or keypoints."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR|FILE")]
    """The folder of the results; or the file of the motion (.bvh, .glb, .npz, ...), and the rest goes
    into a folder of its name."""
    policy: Annotated[Path | None, arg(metavar="FILE|RUN", help_behavior_hint="")] = None
    """A policy file, or the folder of a run of poise train perpetual; by default the one that comes with
    Poise."""
    reset_on_fail: bool = False
    """Put a character that is 0.5 m off back onto the motion, and go on."""
    count: Annotated[int, arg(metavar="N")] = 1
    """Characters who do the motion side by side in one world, where they may collide."""
    noise: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KIND:STRENGTH")] = ()
    """Errors of a pose estimator on the input, such as jitter:1 or video:0.5."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of the noise."""
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
    out, motion = places(o.clip, o.out)
    if motion is not None and o.count > 1:
        raise PoiseError("several characters make several files", motion, "Give a folder as -o")
    from poise.recipes.track import TrackConfig, track, write
    from poise.recipes.track.noise import noise_of
    from poise.recipes.track.policy import open_tracker, save_tracker

    noise = noise_of(o.noise)
    given = read(o.clip, o.reading)
    with working("opening the policy"):
        tracker = open_tracker(o.policy)
    with claimed(out), working("tracking"):
        config = TrackConfig(noise, o.seed, o.reset_on_fail, o.reading.smooth, o.count)
        tracked = track(tracker, given, config)
        done = write(tracked, out, motion, o.hold_feet)
        if o.save_policy is not None:
            save_tracker(tracker, o.save_policy)
    print_card(done.card)
    notes((*tracked.notes, *done.notes))
    say(outcome(tracked, o.reset_on_fail))
    for path in (*done.paths.values(), *((o.save_policy,) if o.save_policy else ())):
        say(str(path))
    return 0


def outcome(tracked: Tracked, reset: bool) -> str:
    """Where the character failed, in one sentence."""
    reference, times = tracked.imitation.reference, tracked.failed_s
    seconds = (int(reference.length[0]) - 1) / reference.rate_hz
    count, fell = len(reference.length), {who for who, _ in tracked.failures}
    if count > 1:
        first = f", the first at {tracked.failures[0][1]:.1f} s" if fell else ""
        again = f"; they were put back {len(tracked.failures)} times" if fell and reset else ""
        return f"{count - len(fell)} of {count} characters tracked all {seconds:.1f} s{first}{again}."
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
    from poise.motion.io.raw import Options as Stated
    from poise.recipes.track.points import points_of

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
