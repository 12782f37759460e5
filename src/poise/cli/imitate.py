"""`poise imitate`: a clip in, the same motion physically simulated out, with a score card.

A policy that knows many motions learns the clip, see `cli.practice`; or one learns it from nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.answer import Answer
from poise.cli.console import launched, print_card
from poise.cli.options import Body, Chosen, Flag, InPlace, Reading, Training, printed
from poise.cli.output import places
from poise.cli.progress import working
from poise.cli.settings import given
from poise.cli.training import Job, command_line, first_delivery, stopped
from poise.errors import PoiseError
from poise.jobs.keep import may_deliver

if TYPE_CHECKING:
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
        raise PoiseError(what, hint="Leave it out, or train from nothing: --from none")
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
        raise PoiseError("is a folder", o.clip, hint)
    again = command_line("imitate", argv)
    from poise.jobs.run_file import RUN_FILE

    out, motion = places(o.out)
    # A run that is not resumed is refused by `Job`, with or without --force: training takes hours.
    held = (out / "run" / RUN_FILE).exists()
    may_deliver(out, motion, o.force or held, o.clip)
    job = Job((o.clip,), out, out / "run", o.training, config, o.reading, again, o.in_place)
    if not from_nothing(o, out / "run"):
        from poise.cli.practice import practise

        if (answer := practise(job, o.going_on, motion, o.hold_feet)) is not None:
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
