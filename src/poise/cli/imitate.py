"""`poise imitate`: a clip in, the same motion physically simulated out, with a score card."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import LOST, Answer, launched, notes, print_card, say, tell
from poise.cli.options import Body, Chosen, Flag, InPlace, Reading, Training, places, printed
from poise.cli.settings import given
from poise.cli.track import follow
from poise.cli.training import (
    Job,
    clock,
    command_line,
    first_delivery,
    held_already,
    left,
    showing,
    stopped,
    working,
)
from poise.errors import PoiseError
from poise.jobs.keep import claimed, may_deliver

if TYPE_CHECKING:
    from poise.jobs.perpetual.stage_order import Progress
    from poise.jobs.track import TrackConfig, Tracked
    from poise.jobs.tracker import Tracker
    from poise.motion import Clip
    from poise.recipes import ResidualForce


@dataclass(frozen=True)
class Options:
    """Give one clip a body: train a policy for it, simulate every start frame, write the motion,
    score.json, report.html and the run itself.

    A policy that knows many motions begins, on its own joints with the bones of the clip: a first result
    comes in seconds by lookahead, and training ends where the motion is done from all over. Any setting
    of the body or the recipe trains from nothing, with a residual force as help."""

    clip: Annotated[Positional[Path], arg(metavar="CLIP")]
    """The motion file."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR|FILE")]
    """The folder of the results; or the file of the motion (.bvh, .glb, .npz, ...), and the rest goes
    into a folder of its name."""
    going_on: Annotated[str | None, arg(name="from", metavar="POLICY|none", help_behavior_hint="")] = (
        None
    )
    """The policy that begins, a file or a run; by default the one that comes with Poise. none trains
    from nothing."""
    in_place: InPlace = "auto"
    """A clip that walks in place is learned with the travel that its feet tell. auto writes it in place
    again, a loop as a loop; travel writes it with its travel; keep takes it as it is. What is learned
    from nothing is written with its travel."""
    hold_feet: Flag = True
    """Leave feet as simulated; by default standing feet are held to the spot in the written motion."""
    force: Flag = False
    """Write over files that are there."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""
    training: OmitArgPrefixes[Training] = field(default_factory=Training)
    recipe_settings: OmitArgPrefixes[Chosen] = field(default_factory=Chosen)
    body: OmitArgPrefixes[Body] = field(default_factory=Body)
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


#: Where no policy begins.
NOTHING = "none"


def blank() -> Options:
    """The options of a command line that only prints its settings."""
    return Options(Path(), Path())


def config_of(o: Options) -> ResidualForce:
    """The recipe's settings, as the command line states them."""
    t = o.training
    t.check(o.recipe_settings)
    from poise.recipes import ResidualForce

    clip = o.reading.read(o.clip) if t.by_clip else None
    return t.settings("residual-force", ResidualForce(), o.body, given(o.recipe_settings), clip)


def from_nothing(o: Options, run: Path) -> bool:
    """Whether no policy begins: as the run does that is there, or by what the command line states."""
    from poise.jobs.run_file import RUN_FILE, read_run
    from poise.recipes import RECIPE

    recipe = {k for k in given(o.recipe_settings, o.body) if k != "seed"}
    recipe |= {k for k in ("preset", "config") if getattr(o.training, k) is not None}
    policy = o.going_on not in (None, NOTHING)
    if recipe and policy:
        what = f"--from goes on with the policy's own settings, and there is {', '.join(sorted(recipe))}"
        raise PoiseError(
            what, hint="Leave it out, or train from nothing: --from none", code="option-conflict"
        )
    if o.training.resume and (run / RUN_FILE).exists():
        return read_run(run).recipe == RECIPE["name"]
    return bool(recipe) or o.going_on == NOTHING or launched()


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Trains, evaluates, delivers; Ctrl-C during training saves and evaluates nothing."""
    o = options
    config = config_of(o)
    if o.training.print_config:
        return printed(config)
    if o.clip.is_dir():
        hint = "Give one clip, or all of them to poise fleet DIR -o OUT"
        raise PoiseError("is a folder", o.clip, hint, code="is-folder")
    again = command_line("imitate", argv)
    from poise.jobs.run_file import RUN_FILE

    out, motion = places(o.out)
    # A run that is not resumed is refused by `Job`, with or without --force: training takes hours.
    held = (out / "run" / RUN_FILE).exists()
    may_deliver(out, motion, o.force or held, o.clip)
    job = Job((o.clip,), out, out / "run", o.training, config, o.reading, again, o.in_place)
    if not from_nothing(o, out / "run"):
        answer = practise(job, o.going_on, motion, o.hold_feet)
        if answer is not None:
            return answer
    from poise.learn.parallel import joined

    with joined() as comm:
        imitation = job.start(comm)
        result = job.train(imitation, comm, first_delivery(imitation, out, motion, o.hold_feet))
    if result.interrupted:
        return stopped(job.run, again)
    if comm.rank:
        return Answer()
    from poise.jobs.deliver import deliver
    from poise.jobs.run_file import learning_curve
    from poise.jobs.runs import evaluate, trained_policy

    try:
        with working("simulating every start frame"):
            trained, device = trained_policy(job.run, imitation), o.training.device
            evaluation = evaluate(imitation, *trained, device=device)
            curve = learning_curve(job.run)
            done = deliver(imitation, evaluation, out, curve, motion, o.hold_feet)
    except KeyboardInterrupt:
        return stopped(job.run, again, " in the evaluation")
    print_card(done.card)
    return Answer(done.card.to_dict(), {**done.paths, "run": job.run}, done.notes)


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
    from poise.jobs.track.tracked import story
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
        from poise.jobs.track.tracked import story

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
