"""`poise imitate`: a clip in, the same motion physically simulated out, with a score card."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import LOST, Answer, launched, print_card, say, tell
from poise.cli.options import (
    Body,
    Chosen,
    Force,
    HoldFeet,
    InPlaceMode,
    Json,
    Out,
    Reading,
    Training,
    places,
    printed,
)
from poise.cli.recipe_options import given
from poise.cli.track import follow
from poise.cli.training import Shown, beginning, clock, command_line, left, stopped, summary
from poise.errors import PoiseError
from poise.jobs.keep import may_deliver

if TYPE_CHECKING:
    from poise.jobs.perpetual.stages import Progress
    from poise.jobs.result import Result
    from poise.jobs.track import TrackConfig
    from poise.jobs.tracker import Tracker
    from poise.learn import PolicyBundle, WarmStart
    from poise.motion import Clip
    from poise.recipes import ResidualForce
    from poise.recipes.imitation import Imitation


@dataclass(frozen=True)
class Options:
    """Give one clip a body: train a policy for it, simulate every start frame, write the motion,
    score.json, report.html and the run itself.

    A policy that knows many motions begins, on its own joints with the bones of the clip: a first result
    comes in seconds by lookahead, and training ends where the motion is done from all over. Any setting
    of the body or the recipe trains from nothing, with a residual force as help."""

    clip: Annotated[Positional[Path], arg(metavar="CLIP")]
    """The motion file."""
    out: Out
    going_on: Annotated[str | None, arg(name="from", metavar="POLICY|none", help_behavior_hint="")] = (
        None
    )
    """The policy that begins, a file or a run; by default the one that comes with Poise. none trains
    from nothing."""
    in_place: InPlaceMode = "auto"
    hold_feet: HoldFeet = True
    force: Force = False
    json: Json = False
    training: OmitArgPrefixes[Training] = Training()
    recipe_settings: OmitArgPrefixes[Chosen] = field(default_factory=Chosen)
    body: OmitArgPrefixes[Body] = Body()
    reading: OmitArgPrefixes[Reading] = Reading()


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
    run = out / "run"
    # A run that is not resumed is refused by `Shown`, with or without --force: training takes hours.
    held = (run / RUN_FILE).exists()
    may_deliver(out, motion, o.force or held, o.clip)
    nothing, t = from_nothing(o, run), o.training
    from poise.jobs.imitate import Job
    from poise.jobs.practice import Watching
    from poise.jobs.result import story

    with Shown((o.clip,), o.reading, t, run, out) as shown:
        mine: dict[str, Any] = {
            "follow": lambda *how: tracks(shown, *how),
            "first": lambda first: first_result(first, out, motion, o.hold_feet),
            "unfit": unfit,
            "iteration": lambda p: practised(shown, p),
            "beginning": lambda task: beginning(first_delivery(task, out, motion, o.hold_feet)),
        }
        told = Watching(**(shown.callbacks | mine))
        how = (t.threads, t.device, o.in_place, told, True)
        try:
            made = Job(shown.read, run, config, t.until(), *how).done(o.going_on, nothing)
            if made is None:
                return Answer()
            with shown.doing("writing"):
                done = made.write(out, motion, o.hold_feet)
        except KeyboardInterrupt:
            return stopped(run, again, shown.where)
    print_card(done.card)
    answer = Answer(done.card.to_dict(), {**done.paths, "run": run}, done.notes)
    if made.placed is None:
        return answer
    became, doubts = story(made, hint=False), made.doubts
    for sentence in (*(doubts if became.failed else ()), became.sentence, *made.sentences):
        say(sentence)
    if became.failed or done.card.help.force_mean_n:
        say(f"Go on with --resume and --minutes {2 * t.minutes:g}.")
    answer.notes, answer.outcome = (*made.notes, *done.notes), became.word
    if became.failed:
        answer.exit_code, answer.said = LOST, doubts
    return answer


def tracks(shown: Shown, policy: Tracker, clip: Clip, config: TrackConfig) -> Result:
    """Tracks, with bars of its own."""
    shown.close()
    return follow(policy, [clip], config, [])


def first_result(first: Result, out: Path, motion: Path | None, hold: bool) -> None:
    """Writes what is done before anything is learned, and says so."""
    from poise.jobs.result import story

    done = first.write(out, motion, hold)
    tell(f"First result: {story(first, hint=False).sentence} See {done.paths['report']}")


def first_delivery(
    task: Imitation, out: Path, motion: Path | None, hold: bool
) -> Callable[[PolicyBundle, WarmStart], None]:
    """Writes the clone's motion, score and report, see `deliver`; training then betters them."""

    def deliver_first(policy: PolicyBundle, start: WarmStart) -> None:
        from poise.jobs.result import Result
        from poise.jobs.runs import evaluate
        from poise.jobs.warm_start import FIRST_STARTS

        meta = {"seconds": start.seconds, "samples": start.samples}
        evaluation = evaluate(task, policy, meta, most=FIRST_STARTS)
        paths = Result(task, evaluation).write(out, motion, hold).paths
        tell(f"first result: {summary(evaluation.card)}; see {paths['report']}")

    return deliver_first


def unfit(problem: PoiseError) -> None:
    """Tells why the policy that comes with Poise does not begin."""
    tell(f"It is learned from nothing, since the policy does not fit: {problem.what}.")


def practised(shown: Shown, p: Progress) -> None:
    """Shows an iteration of a training on one motion."""
    spent = f"{clock(p.stats.seconds)}, {left(p.stats.seconds, p.share)} at most"
    aid = f", with help of at most {p.help_n:.0f} N" if p.help_n else ""
    shown.bar(p.share, f"{spent}  {p.stats.samples_per_s:,.0f} samples/s{aid}")
    if p.results is not None:
        share, off = 100 * p.results.tracked_share, p.results.error_mm
        tell(f"{clock(p.stats.seconds)}  the policy tracks {share:.0f} %, {off:.0f} mm off{aid}")
