"""`poise train perpetual`: one policy for a whole library, stage after stage without a manual step."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar
from tyro.conf import arg

from poise.cli import progress
from poise.cli.beginning import beginning
from poise.cli.console import err, notes, say, table, tell
from poise.cli.options import Body, Training
from poise.cli.output import claimed
from poise.cli.progress import EVERY_S, clock
from poise.cli.train_inbetween import Network
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.learn import Until
    from poise.recipes.imitation import Imitation
    from poise.recipes.perpetual import Perpetual
    from poise.recipes.perpetual_progress import Progress
    from poise.recipes.perpetual_run import PerpetualResult

#: Clips that are named in the end.
NAMED = 10


@dataclass(frozen=True)
class Primitives:
    """What only the recipe perpetual knows."""

    single: bool = False
    """perpetual: one larger network in place of primitives and a composer."""
    max_primitives: Annotated[int, arg(metavar="K")] = 3
    """perpetual: train at most so many primitives, each on what the ones before it fail."""


def run(
    network: Network, primitives: Primitives, out: Path, training: Training, body: Body, again: str
) -> int:
    """Trains until nothing fails, a limit is reached, or Ctrl-C."""
    if network.library is None:
        hint = "Write poise train perpetual --library DIR -o RUNDIR"
        raise PoiseError("the recipe perpetual needs --library", hint=hint)
    training.check()
    config = settings(primitives, training, body)
    from poise.learn import Until
    from poise.recipes.perpetual_run import train
    from poise.recipes.session import RUN_FILE

    held = (out / RUN_FILE).exists()
    if held and not training.resume:
        raise PoiseError("already holds a run", out, "Go on with --resume, or choose another folder")
    imitation = begin(network, out, config, training, held)
    until = Until(minutes=training.minutes, iterations=training.iterations)
    t, result = training, None
    with contextlib.suppress(KeyboardInterrupt), showing(until) as show:
        # A second Ctrl-C ends the present iteration too; what is in the last checkpoint stays.
        result = train(imitation, out, until, show, t.threads, device=t.device, beginning=beginning())
    if result is None or result.interrupted:
        where = "" if result is None or result.last is None else f" in {result.last.stage.name}"
        tell(f"Stopped{where}; the training so far is saved. Go on with:")
        tell(f"  {again}")
        return 130
    report(imitation, result, out)
    return 0


def settings(primitives: Primitives, training: Training, body: Body) -> Perpetual:
    """The recipe's settings; options that belong to other recipes are refused."""
    plain = Training()
    for name in ("method", "reward", "help_limit"):
        if getattr(training, name) != getattr(plain, name):
            option = name.replace("_", "-")
            raise PoiseError(f"the recipe perpetual has no --{option}", hint="Leave it out")
    if not 1 <= primitives.max_primitives <= 64:
        raise PoiseError(f"--max-primitives must lie in 1 to 64, got {primitives.max_primitives}")
    from poise.recipes.perpetual import Perpetual

    config = Perpetual(
        single=primitives.single,
        max_primitives=primitives.max_primitives,
        help_start=training.help_start,
        seed=training.seed,
        expert=training.expert,
        body=body.config(),
    )
    return config if training.envs is None else replace(config, num_envs=training.envs)


def begin(network: Network, out: Path, config: Perpetual, training: Training, held: bool) -> Imitation:
    """Reads the folder, tries the run folder, builds the task; nothing stays if that fails.

    held: the run folder holds a run already, which then is all that is read.
    """
    from poise.recipes import perpetual_run

    assert network.library is not None
    hold_out, never = ((p,) if p else () for p in (network.hold_out, network.never))
    source = ", without ".join((str(network.library.resolve()), *hold_out, *never))
    if held:
        with progress.working("opening the run"):
            return perpetual_run.resume(out, config, source, training.device)
    if training.resume:
        tell(f"There was no run in {out}; a new one starts.")
    clips, said = perpetual_run.clips_of(network.library, config.body, hold_out, never, tell)
    say(f"{len(clips)} clips, {clock(clips.seconds)}")
    notes(said)
    with claimed(out), progress.working("making the body"):
        return perpetual_run.begin(out, clips, config, source, training.device)


def report(imitation: Imitation, result: PerpetualResult, out: Path) -> None:
    """What the run came to, and which clips are the hardest."""
    if result.last is None:
        say(f"{out} had reached its limit before; nothing was trained.")
    else:
        stats = result.last.stats
        say(f"Trained {clock(stats.seconds)}, {stats.samples:,} samples, {parts(result)}")
    r, names = result.results, imitation.library.names
    assert r is not None
    won, total = int(r.succeeded.sum()), len(r.clip)
    say(f"Without help {won} of {total} clips succeed ({100 * r.rate:.1f} %), {r.error_mm:.0f} mm")
    if hard := r.hardest(NAMED):
        rows = []
        for c in hard:
            k = r.clip.tolist().index(c)
            rows.append((names[c], f"{int(r.tracked[k])} of {int(r.frames[k])}"))
        table(f"The hardest of {total - won} that fail", ("clip", "frames tracked"), rows)
    say(str(out))


def parts(result: PerpetualResult) -> str:
    """What was trained, in words."""
    n = result.primitives
    made = f"{n} primitive{'s' if n > 1 else ''}" if n else "one network"
    return f"{made}; nothing fails any more" if result.solved else made


def figures(p: Progress) -> str:
    """What one iteration says: the stage, its clips, the speed."""
    won = "" if p.succeeded is None else f"  {p.succeeded} of {p.clips} clips"
    helped = f"  help at most {p.help_n:.0f} N" if p.help_n else "  no help"
    reward = p.stats.terms.get("imitation", p.stats.reward)
    speed = f"{p.stats.samples_per_s:,.0f} samples/s"
    return f"{p.stage.name}{won}  {speed}  imitation {reward:.3f}{helped}"


def times(p: Progress) -> str:
    """How far it is: "1:20, 8:40 left"."""
    left = p.stats.seconds * (1 - p.share) / p.share if p.share else math.nan
    return f"{clock(p.stats.seconds)}, {'?' if math.isnan(left) else clock(left)} left"


def events(p: Progress) -> None:
    """A line for each evaluation, where another stage begins, and for what went wrong."""
    if p.trouble:
        tell(
            f"Gone on from the last checkpoint with other draws, since a simulation failed: {p.trouble}"
        )
    if p.results is not None:
        won, total = int(p.results.succeeded.sum()), len(p.results.clip)
        tell(
            f"{clock(p.stats.seconds)}  {p.stage.name}: {won} of {total} clips succeed, "
            f"{p.results.error_mm:.0f} mm"
        )
    if p.following is not None:
        tell(f"{clock(p.stats.seconds)}  {p.following.name} begins")


@contextlib.contextmanager
def showing(until: Until) -> Iterator[Callable[[Progress], None]]:
    """A bar in a terminal, a line now and then elsewhere."""
    console, last = err(), [-math.inf]

    def line(p: Progress) -> None:
        if time.monotonic() - last[0] >= EVERY_S or p.share >= 1.0:
            last[0] = time.monotonic()
            tell(f"{times(p)}  {figures(p)}")
        events(p)

    if not console.is_terminal:
        yield line
        return
    columns = (TextColumn("{task.description}"), BarColumn(20), TextColumn("{task.fields[what]}"))
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("training", total=1.0, what="")

        def show(p: Progress) -> None:
            bar.update(task, completed=p.share, what=f"{times(p)}  {figures(p)}")
            events(p)

        yield show
