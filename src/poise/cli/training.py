"""Steps that `imitate` and `train` share: check, read, build, train, the learning curve meanwhile."""

from __future__ import annotations

import contextlib
import math
import os
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from poise.cli.console import INTERRUPTED, Answer, err, launched, notes, say, tell
from poise.cli.options import Reading, Training
from poise.errors import PoiseError
from poise.jobs.keep import EVALUATING

if TYPE_CHECKING:
    from poise.jobs.warm_start import TrainingCallbacks
    from poise.learn import CloneStats, IterationStats, PolicyBundle, Until, WarmStart
    from poise.motion import Clip, ClipLibrary
    from poise.papers.perpetual.trajopt import TrajOptStats
    from poise.recipes.imitation import Imitation
    from poise.score import ScoreCard


#: Seconds between two lines where there is no terminal.
EVERY_S = 30.0
#: A file into which what is simulated is written as it goes, for a page that shows it; None writes none.
DRAWS: Path | None = None


def clock(seconds: float) -> str:
    """Minutes and seconds, with hours where there are any: "4:05"."""
    whole = max(0, round(seconds))
    hours, rest = divmod(whole, 3600)
    return (f"{hours}:{rest // 60:02d}" if hours else f"{rest // 60}") + f":{rest % 60:02d}"


def share_done(stats: IterationStats, until: Until) -> float:
    """How much of the nearest limit is used up, 0 to 1."""
    return until.share(stats.iteration, stats.samples, stats.seconds)


def left(seconds: float, share: float) -> str:
    """What is left of work of which a share took so many seconds: "8:40 left"."""
    return f"{clock(seconds * (1 / share - 1))} left" if share else "? left"


def figures(stats: IterationStats) -> str:
    """An iteration in a line."""
    reward = stats.terms.get("imitation", stats.reward)
    # Nothing is known about episodes before the first one has ended.
    ended = (
        ""
        if math.isnan(stats.episode_length)
        else (f"  episode {stats.episode_length:.0f} steps  failures {100 * stats.failure_rate:.0f} %")
    )
    limit, force = stats.terms.get("help/limit_n"), stats.terms.get("help/force_n")
    helped = "  no help" if limit == 0 else f"  help at most {limit or 0:.0f} N"
    if limit is None:
        helped = "" if force is None else f"  help {force:.0f} N, without a limit"
    return f"{stats.samples_per_s:,.0f} samples/s  imitation {reward:.3f}{ended}{helped}"


def times(stats: IterationStats, until: Until) -> str:
    """Elapsed, limit and what is left: "1:20 of 10:00, 8:40 left"."""
    done = share_done(stats, until)
    if until.iterations and stats.iteration / until.iterations == done:
        return f"iteration {stats.iteration} of {until.iterations}, {left(stats.seconds, done)}"
    limit = f" of {clock(60 * until.minutes)}" if until.minutes else ""
    return f"{clock(stats.seconds)}{limit}, {left(stats.seconds, done)}"


@contextlib.contextmanager
def showing(title: str, at_once: bool = True) -> Iterator[Callable[[float, str], None]]:
    """Gives the function that shows a share, 0 to 1, and a text: a bar in a terminal, elsewhere a line
    every `EVERY_S`, and with `at_once` also at the beginning and at the end."""
    console, last = err(), [float("-inf") if at_once else time.monotonic()]
    if not console.is_terminal:

        def line(done: float, what: str) -> None:
            if time.monotonic() - last[0] >= EVERY_S or (at_once and done >= 1):
                last[0] = time.monotonic()
                tell(what)

        yield line
        return
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(20), TextColumn("{task.fields[what]}"))
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=1.0, what="")
        yield lambda done, what: bar.update(task, completed=done, what=what)


@contextlib.contextmanager
def training(until: Until) -> Iterator[Callable[[IterationStats], None]]:
    """Gives the function that shows one iteration."""
    with showing("training") as show:
        yield lambda stats: show(share_done(stats, until), f"{times(stats, until)}  {figures(stats)}")


@contextlib.contextmanager
def working(what: str) -> Iterator[None]:
    """A spinner in a terminal while something takes seconds, elsewhere a line."""
    console = err()
    if not console.is_terminal:
        tell(what, "dim")
        yield
        return
    from rich.text import Text

    with console.status(Text(what)):
        yield


def staged(shown: contextlib.ExitStack) -> Callable[[str, int, int], None]:
    """Told what is done, and how much of how much, it shows a bar for each, with the time left; what
    `shown` holds ends with the first."""
    began, now = time.monotonic(), ""
    bar: Callable[[float, str], None] | None = None

    def show(what: str, done: int, of: int) -> None:
        nonlocal began, now, bar
        if bar is None or what != now:
            shown.close()
            began, now = time.monotonic(), what
            bar = shown.enter_context(showing(what))
        share = done / max(of, 1)
        bar(share, f"{what}, {100 * share:.0f} % done, {left(time.monotonic() - began, share)}")

    if DRAWS is None:
        return show
    from poise.live.open.preview import Preview

    return Preview(show, DRAWS)


def held_already(out: Path) -> PoiseError:
    """What is said of a run that is there and was not asked to go on."""
    return PoiseError(
        "already holds a run", out, "Go on with --resume, or choose another folder", code="run-exists"
    )


def refuse_held(out: Path, run_file: str, training: Training) -> None:
    """Refuses a folder that holds a run, unless that is to go on."""
    if (out / run_file).exists() and not training.resume:
        raise held_already(out)


def on_the_cpu(recipe: str, training: Training) -> None:
    """Refuses another device for a recipe that has none."""
    if training.device != "cpu":
        raise PoiseError(
            f"the recipe {recipe} trains on the CPU",
            hint="Leave --device out",
            code="option-not-applicable",
        )


class Trained(Protocol):
    """The last lines of a training."""

    @property
    def seconds(self) -> float: ...
    @property
    def samples(self) -> int: ...


def finished(
    out: Path, last: Trained | None, limit: str, what: str, then: str = ""
) -> dict[str, float] | None:
    """Says how a training of one process ended, and what to do next; gives that for --json.

    last: None where nothing was trained. limit: what ended it before. what: `samples` are counted.
    then: the command that uses the result.
    """
    if last is None:
        say(f"{out} had reached its {limit} before; nothing was trained.")
        return None
    say(f"Trained {last.seconds:.0f} s, {last.samples:,} {what}")
    if then:
        say(then)
    return {"seconds": last.seconds, "samples": last.samples}


def stopped(run: Path, again: str, where: str = "") -> Answer:
    """Says what Ctrl-C left in the run folder, and the command line that goes on with it."""
    from poise.learn import LATEST

    if (run / LATEST).exists():
        tell(f"Stopped{where}; the training so far is saved. Go on with:")
    else:
        tell(f"Stopped{where} before there was anything to save. Begin again with:")
    tell(f"  {again}")
    return Answer({"again": again}, exit_code=INTERRUPTED)


def command_line(verb: str, argv: Sequence[str]) -> str:
    """The command line that resumes `poise VERB ARGV`, as one process or as `torchrun` runs it."""
    more = () if "--resume" in argv else ("--resume",)
    program: tuple[str, ...] = ("poise",)
    if launched():
        here, all_ = os.environ["LOCAL_WORLD_SIZE"], os.environ["WORLD_SIZE"]
        nodes = () if here == all_ else ("--nnodes", str(int(all_) // int(here)))
        program = ("torchrun", *nodes, "--nproc-per-node", here, "-m", "poise")
    return shlex.join((*program, verb, *argv, *more))


def beginning(
    first: Callable[[PolicyBundle, WarmStart], None] | None = None,
) -> TrainingCallbacks:
    """Callbacks that tell the steps before PPO begins; `first` gets the clone."""
    from poise.jobs.warm_start import TrainingCallbacks

    def expert(card: ScoreCard) -> None:
        tell(f"expert, without learning: {summary(card)}")

    def cloned_round(s: CloneStats) -> None:
        tell(f"{clock(s.seconds)}  cloning, round {s.round}: {s.samples:,} samples, error {s.loss:.3f}")

    def failed(why: str) -> None:
        tell(f"Training starts from nothing, since the expert failed: {why}")

    def path(s: TrajOptStats, of: int) -> None:
        figures = f"root off by {1000 * s.error_m:.0f} mm, help {s.help_n:.0f} N"
        share = f"{100 * s.unhelped:.0f} % without, {left(s.seconds, s.iteration / of)}"
        tell(f"{clock(s.seconds)}  path {s.iteration} of {of}: {figures}, {share}")

    return TrainingCallbacks(expert, cloned_round, first, failed, path)


class Shown:
    """Progress while a motion is learned, one bar at a time: see `jobs.practice.Watching`.

    clips: the files that are read. out: the folder that is named where `run` is there already.
    """

    def __init__(
        self, clips: Sequence[Path], reading: Reading, training: Training, run: Path, out: Path
    ):
        self._clips, self._reading, self._training = clips, reading, training
        self._run, self._out = run, out
        self._bar: Callable[[float, str], None] | None = None
        self._shown = contextlib.ExitStack()
        self._held, self.where = False, ""

    def __enter__(self) -> Shown:
        return self

    def __exit__(self, *problem: object) -> None:
        self._shown.close()

    def read(self) -> list[Clip]:
        """The clips, unless the folder holds a run that is not to go on."""
        from poise.jobs.run_file import RUN_FILE

        self._held = (self._run / RUN_FILE).exists()
        if self._held and not self._training.resume:
            raise held_already(self._out)
        return [self._reading.read(path) for path in self._clips]

    def given(self, library: ClipLibrary) -> None:
        """Says what was read."""
        say(f"{', '.join(library.names[:6])}: {library.seconds:.1f} s")
        notes([n for clip in library for n in clip.skeleton.source.notes])

    @contextlib.contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """What takes seconds."""
        self.close()
        if what == EVALUATING:
            self.where = " in the evaluation"
        with working(what):
            yield

    def close(self) -> None:
        """Ends the bar."""
        self._shown.close()
        self._bar = None

    def begun(self, task: Imitation) -> None:
        """Says what the body came to."""
        if self._training.resume and not self._held:
            tell(f"There was no run in {self._run}; a new one starts.")
        notes(task.report.sentences())
        if self._training.device != "cpu":
            tell("The first steps on a new GPU compile its kernels, which takes minutes once.", "dim")

    def stats(self, stats: IterationStats) -> None:
        """Shows an iteration of a training from nothing."""
        until = self._training.until()
        self.bar(share_done(stats, until), f"{times(stats, until)}  {figures(stats)}")

    def bar(self, share: float, text: str) -> None:
        """Shows how much of the training is done."""
        if self._bar is None:
            self._bar = self._shown.enter_context(showing("training"))
        self._bar(share, text)

    def say(self, sentence: str) -> None:
        """Tells a sentence."""
        tell(sentence, "yellow")

    @property
    def callbacks(self) -> dict[str, Any]:
        """The callbacks of a job, see `jobs.practice.Watching`."""
        own = {name: getattr(self, name) for name in ("say", "doing", "given", "begun", "stats")}
        return {"beginning": lambda _: beginning(), **own}


def summary(card: ScoreCard) -> str:
    """A score card in half a line: "succ 97 %, 19 mm, help 69 N and 28 N m"."""
    aid = card.help
    return (
        f"succ {100 * card.succ:.0f} %, {card.mpjpe_mm:.0f} mm, "
        f"help {aid.force_mean_n:.0f} N and {aid.torque_mean_nm:.0f} N m"
    )
