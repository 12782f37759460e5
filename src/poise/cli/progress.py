"""The learning curve while it grows: a bar in a terminal, a line now and then elsewhere."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from poise.cli.console import err, tell

if TYPE_CHECKING:
    from poise.learn import IterationStats, Until

#: Seconds between two lines where there is no terminal.
EVERY_S = 30.0


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
    """What one iteration says about the learning."""
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

    return show
