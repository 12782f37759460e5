"""What `poise train perpetual` shows: a line while it trains, events, what it came to."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from poise.cli.answer import Answer
from poise.cli.console import say, table, tell
from poise.cli.progress import clock, left, showing

if TYPE_CHECKING:
    from poise.eval import RecoveryCard
    from poise.jobs.perpetual.run import PerpetualResult
    from poise.jobs.perpetual.stage_order import Progress
    from poise.recipes.imitation import Imitation

#: Clips that are named in the end.
NAMED = 10


def report(imitation: Imitation, result: PerpetualResult, out: Path) -> Answer:
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
    if result.recovery is not None:
        say(recovered(result.recovery))
    if hard := r.hardest(NAMED):
        rows = []
        for c in hard:
            k = r.clip.tolist().index(c)
            rows.append((names[c], f"{int(r.tracked[k])} of {int(r.frames[k])}"))
        table(f"The hardest of {total - won} that fail", ("clip", "frames tracked"), rows)
    figures = {"succeeded": won, "clips": total, "succ": r.rate, "error_mm": r.error_mm}
    return Answer(figures, {"run": out})


def recovered(card: RecoveryCard) -> str:
    """What trials of recovery came to: "Recovery: fallen 95 % within 5 s and 99 % within 10 s; ..."."""
    rows = []
    for row in card.rows:
        each = (f"{100 * x:.0f} % within {t:g} s" for x, t in zip(row.within, card.seconds, strict=True))
        rows.append(f"{row.kind} {' and '.join(each)}")
    return f"Recovery, {card.rows[0].trials} trials each: {'; '.join(rows)}"


def parts(result: PerpetualResult) -> str:
    """What was trained, in words."""
    n = result.primitives
    made = f"{n} primitive{'s' if n > 1 else ''}" if n else "one network"
    return f"{made}; nothing fails any more" if result.solved else made


def figures(p: Progress) -> str:
    """What one iteration says: the stage, its clips, the speed."""
    what = "trials" if p.stage.kind == "recovery" else "clips"
    won = "" if p.succeeded is None else f"  {p.succeeded} of {p.clips} {what}"
    helped = f"  help at most {p.help_n:.0f} N" if p.help_n else "  no help"
    reward = p.stats.terms.get("imitation", p.stats.reward)
    speed = f"{p.stats.samples_per_s:,.0f} samples/s"
    return f"{p.stage.name}{won}  {speed}  imitation {reward:.3f}{helped}"


def times(p: Progress) -> str:
    """How far it is: "1:20, 8:40 left"."""
    return f"{clock(p.stats.seconds)}, {left(p.stats.seconds, p.share)}"


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
    if p.recovery is not None:
        tell(f"{clock(p.stats.seconds)}  {p.stage.name}: {recovered(p.recovery)}")
    if p.following is not None:
        tell(f"{clock(p.stats.seconds)}  {p.following.name} begins")


@contextlib.contextmanager
def shown() -> Iterator[Callable[[Progress], None]]:
    """A bar in a terminal, a line now and then elsewhere, and `events`."""
    with showing("training") as show:

        def one(p: Progress) -> None:
            show(p.share, f"{times(p)}  {figures(p)}")
            events(p)

        yield one
