"""`poise track`: motions in, the same motions done by a trained policy out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from poise.cli.console import INTERRUPTED, LOST, Answer, print_card, say, tell
from poise.cli.options import (
    Directing,
    Flag,
    Force,
    HoldFeet,
    Json,
    Out,
    PolicyFile,
    Reading,
    check_range,
    each,
    places,
)
from poise.cli.recipe_options import TRACK, derived, given
from poise.cli.training import clock, left, showing, staged, working
from poise.errors import PoiseError
from poise.jobs.keep import claimed, may_deliver, may_write

if TYPE_CHECKING:
    from poise.jobs.perpetual.stages import Progress
    from poise.jobs.result import Result
    from poise.jobs.track_settings import TrackConfig
    from poise.jobs.tracker import Tracker
    from poise.kinematics.supports import Support
    from poise.motion import Clip
    from poise.motion.keypoints import Keypoints

    Tracking: TypeAlias = Any
else:
    NAMES = "controller body reset_on_fail recover count seed threads in_place help_limit"
    Tracking = derived(TRACK, "", *NAMES.split())


@dataclass(frozen=True)
class Options:
    """Let a trained policy do a motion that it need not know, without training, and without help unless
    some is allowed: write the motion, score.json and report.html. It looks ahead, and a motion that is
    lost so is searched; what is lost then it can --learn. Several motions are done one after another in
    one episode, each where it stands: between them the character walks, turns and gets up to the next
    one's start."""

    out: Out
    clips: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="FILE ...", help_behavior_hint="(required)")
    ] = ()
    """Motion files: clips of any human skeleton, or keypoints; or one folder, each file on its own."""
    policy: PolicyFile = None
    characters: Annotated[int, arg(metavar="N")] = 512
    """Characters that search at once; more find harder motions."""
    rounds: Annotated[int, arg(metavar="N")] = 1
    """How often the motion is searched; later rounds stay about what was found, and come nearer."""
    learn: Annotated[float, arg(metavar="MINUTES")] = 0.0
    """If the policy loses the motion, train it on that motion first, for so many minutes at most. What
    it learned is kept in learned/ of the folder; the same command goes on where it was stopped."""
    supports: Flag = True
    """Put nothing beside the motion; by default a box stands where a single motion sits, leans or steps
    on something, and a sentence says so."""
    support: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Boxes beside the motion that stand there instead (.json), such as a result's supports.json."""
    noise: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KIND:STRENGTH")] = ()
    """Errors of a pose estimator on the input, such as jitter:1 or video:0.5."""
    hold_feet: HoldFeet = True
    save_policy: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write the policy as one file (.safetensors), which starts faster than a run folder."""
    force: Force = False
    json: Json = False
    tracking: OmitArgPrefixes[Tracking] = field(default_factory=Tracking)
    directing: OmitArgPrefixes[Directing] = Directing()
    reading: OmitArgPrefixes[Reading] = Reading()


def run(options: Options, argv: Sequence[str]) -> Answer:
    """One motion, several in a row, or each of a folder with one policy, into a folder of its name."""
    check(o := options)
    if not any(clip.is_dir() for clip in o.clips):
        return track_one(o)
    if o.save_policy is not None:
        raise PoiseError("--save-policy is for one motion", hint="Leave it out", code="single-clip-only")
    from poise.jobs.open import open_run

    with claimed(o.out):
        with working("opening the policy"):
            tracker = open_run(o.policy).tracker

        def one(path: Path, name: str) -> Answer:
            return track_one(replace(o, clips=(path,), out=o.out / name), tracker, o.out / name)

        return each("track", o.clips, o.out, one)


def config_of(o: Options) -> TrackConfig:
    """How it is tracked, as the command line states it."""
    from poise.jobs.track.robustness import noise_of
    from poise.jobs.track_settings import TrackConfig
    from poise.plan import SamplingConfig

    more = given(o.tracking) | o.directing.values()
    how = {"noise": noise_of(o.noise), "supports": supports_wanted(o), "smooth_hz": o.reading.smooth}
    check_range("characters", o.characters, 8, 65_536)
    check_range("rounds", o.rounds, 1, 20)
    search = SamplingConfig(o.characters, rounds=o.rounds)
    config = TrackConfig(search=search, **how, **more)
    config.check(len(o.clips))
    return config


def check(o: Options) -> None:
    """Refuses what makes no sense, before anything is read or made."""
    if not o.clips:
        raise PoiseError(
            "poise track needs a motion file", hint="See poise track --help", code="argument-missing"
        )
    several = len(o.clips) > 1
    if several and (folder := next((c for c in o.clips if c.is_dir()), None)):
        raise PoiseError(
            "is a folder, and several clips are done in a row",
            folder,
            "Name its files",
            code="is-folder",
        )
    if several and o.learn:
        raise PoiseError(
            "--learn is for a single clip",
            hint="Leave it out, or learn clip by clip",
            code="single-clip-only",
        )
    check_range("learn", o.learn, 0, 100_000)
    config = config_of(o)
    if o.learn and config.body == "own":
        raise PoiseError(
            "the policy learns on its own body",
            hint="Leave --body own or --learn out",
            code="option-conflict",
        )
    if o.learn and config.retake:
        raise PoiseError(
            "--learn learns the whole motion, and --range does a part",
            hint="Leave one out",
            code="option-conflict",
        )
    if o.learn and config.noise:
        what = "--learn learns the motion without errors, and --noise adds some"
        raise PoiseError(what, hint="Leave one out", code="option-conflict")


def track_one(options: Options, tracker: Tracker | None = None, folder: Path | None = None) -> Answer:
    """Opens the policy, reads, tracks, writes; says where the character failed. folder: of the results,
    where that is settled."""
    o = options
    from poise.jobs.run_file import RUN_FILE

    out, motion = places(o.out) if folder is None else (folder, None)
    goes_on = o.learn > 0 and (out / "learned" / RUN_FILE).exists()
    may_deliver(out, motion, o.force or goes_on, *o.clips)
    if o.save_policy is not None:
        may_write(o.save_policy, o.force)
    if motion is not None and (o.tracking.count or 1) > 1:
        raise PoiseError(
            "several characters make several files", motion, "Give a folder as -o", code="folder-needed"
        )
    from poise.jobs.open import open_run
    from poise.jobs.result import story
    from poise.jobs.tracker import save_tracker

    config = config_of(o)
    motions = [read(clip, o.reading) for clip in o.clips]
    if tracker is None:
        with working("opening the policy"):
            tracker = open_run(o.policy).tracker
    with claimed(out):
        # What is to be learned is the motion alone.
        plain = replace(config, recover=False, controller="policy") if o.learn else config
        said_early = list[str]()
        tracked = follow(tracker, motions, plain, said_early)
        if o.learn and tracked.failures:
            if (learned := practise(o, tracker, tracked, out / "learned")) is None:
                kept = {"learned": out / "learned"}
                return Answer(outputs=kept, exit_code=INTERRUPTED, outcome="interrupted")
            tracker, before = learned, tracked
            tracked = max(follow(learned, motions, config, said_early), before, key=lambda t: t.merit)
            if tracked is before:
                tell("What was learned does it no better: the motion as it was before stays.")
        with working("writing"):
            done = tracked.write(out, motion, o.hold_feet)
            if o.save_policy is not None:
                save_tracker(tracker, o.save_policy)
    print_card(done.card)
    told = story(tracked, config.reset_on_fail)
    if told.failed:
        for doubt in (d for d in tracked.doubts if d not in said_early):
            say(doubt)
    say(told.sentence)
    for part in tracked.parts:
        say(part.sentence())
    if told.word == "lost":
        say(advice(o, config, tracked))
    failures = [{"character": k, "seconds": t} for k, t in tracked.failures]
    result = {
        "outcome": told.word,
        "controller": tracked.controller,
        "sentence": told.sentence,
        "failures": failures,
        "supports": [s.to_dict() for s in tracked.supports],
        "in_place": tracked.travel and tracked.travel.to_dict(),
        "clips": [asdict(part) | {"done": part.done} for part in tracked.parts],
        "score": done.card.to_dict(),
    }
    saved = {"policy": o.save_policy} if o.save_policy else {}
    if o.learn and (out / "learned" / RUN_FILE).exists():
        saved["learned"] = out / "learned"
    said = (*tracked.notes, *done.notes)
    early = (*said_early, *(tracked.doubts if told.failed else ()))
    code = LOST if told.failed else 0
    return Answer(result, {**done.paths, **saved}, said, code, told.word, done.card.mpjpe_mm, early)


def supports_wanted(options: Options) -> Literal["auto", "none"] | tuple[Support, ...]:
    """What is to stand beside the motion."""
    from poise.kinematics.supports import read_supports

    if options.support is not None:
        if not options.supports:
            raise PoiseError(
                "--support states what --no-supports forbids",
                hint="Leave one out",
                code="option-conflict",
            )
        return read_supports(options.support)
    return "auto" if options.supports else "none"


def follow(
    tracker: Tracker,
    given: Sequence[Clip | Keypoints],
    config: TrackConfig,
    said: list[str],
    what: str = "tracking",
) -> Result:
    """The motions as they are tracked, with a bar while it is looked ahead or searched. What speaks
    against a motion is told before it is simulated, and once: `said` is what was."""
    from poise.jobs.track import track

    with contextlib.ExitStack() as shown:
        shown.enter_context(working(what))
        return track(given, tracker, config, progress=staged(shown), warn=telling(said))


def telling(said: list[str]) -> Callable[[str], None]:
    """Tells each sentence once: `said` is what was."""

    def warn(sentence: str) -> None:
        if sentence not in said:
            said.append(sentence)
            tell(sentence, "yellow")

    return warn


def practise(options: Options, tracker: Tracker, tracked: Result, folder: Path) -> Tracker | None:
    """The policy after it has learned the motion; None where Ctrl-C ended that."""
    from poise.jobs.track.learning import learn
    from poise.learn import Until

    o, when, rate = options, tracked.failures[0][1], tracker.config.sim.control_hz
    tell(f"The policy loses the motion at {when:.1f} s and learns it now, {o.learn:g} minutes at most.")
    with showing("learning") as bar:

        def show(p: Progress) -> None:
            spent = f"{clock(p.stats.seconds)}, {left(p.stats.seconds, p.share)}"
            bar(p.share, f"{spent}  {p.stats.samples_per_s:,.0f} samples/s")
            if p.results is not None:
                came, whole = (float(x) / rate for x in (p.results.tracked, p.results.frames))
                tell(f"{clock(p.stats.seconds)}  it gets to {came:.1f} of {whole:.1f} s")

        until = Until(minutes=o.learn)
        threads, seed = o.tracking.threads or 0, o.tracking.seed or 0
        learned = learn(tracker, tracked.placed, folder, until, show, threads, seed)
    if learned.result.interrupted:
        tell("Stopped; what was learned is saved. The same command goes on.")
        return None
    if learned.result.last is not None:
        stats = learned.result.last.stats
        tell(f"Learned {clock(stats.seconds)}, {stats.samples:,} samples.")
    return learned.tracker


def advice(options: Options, config: TrackConfig, tracked: Result) -> str:
    """What to do about a motion that was lost."""
    o = options
    if tracked.parts:
        back = "With --recover the character comes back to a clip that it lost. "
        told = "poise track CLIP does a single clip, and searches what is lost."
        return told if config.recover else back + told
    learns = "with --learn 10 the policy first learns this motion, for 10 minutes at most."
    if o.learn:
        return f"The same command with more minutes goes on learning: --learn {2 * o.learn:g}."
    if tracked.found is not None:
        return f"Try --characters {2 * o.characters}; or {learns}"
    back = config.recover or config.reset_on_fail
    if config.count == 1 and config.controller != "auto" and not back:
        return f"With --controller auto many characters search what is lost; {learns}"
    return "W" + learns[1:]


def read(path: Path, reading: Reading) -> Clip | Keypoints:
    """The motion in a file; keypoints stay keypoints."""
    from poise.formats.raw import ReadOptions as Stated
    from poise.jobs.track.placement import points_of

    clip = reading.read(path)
    if reading.ground is not None or reading.swap_sides:
        # What was stated about the skeleton is known to the clip alone.
        return clip
    stated = Stated(
        fps=reading.fps, unit_m=reading.unit_m(), up_axis=reading.up, take=reading.take, raw=reading.raw
    )
    return points_of(clip, stated) or clip
