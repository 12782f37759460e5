"""What is said while a run begins: the expert's score, the rounds of cloning, the first result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from poise.cli.console import tell
from poise.cli.progress import clock

if TYPE_CHECKING:
    from poise.eval import ScoreCard
    from poise.jobs.warm_start import TrainingCallbacks
    from poise.learn import CloneStats, PolicyBundle, WarmStart
    from poise.plan import TrajOptStats
    from poise.recipes.imitation import Imitation

First = Callable[["PolicyBundle", "WarmStart"], None]


def beginning(first: First | None = None) -> TrainingCallbacks:
    """Callbacks that tell the steps before PPO begins; `first` gets the clone."""
    from poise.jobs.warm_start import TrainingCallbacks

    def expert(card: ScoreCard) -> None:
        tell(f"expert, without learning: {summary(card)}")

    def cloned_round(s: CloneStats) -> None:
        tell(f"{clock(s.seconds)}  cloning, round {s.round}: {s.samples:,} samples, error {s.loss:.3f}")

    def failed(why: str) -> None:
        tell(f"Training starts from nothing, since the expert failed: {why}")

    def path(s: TrajOptStats, of: int) -> None:
        left = clock(s.seconds / s.iteration * (of - s.iteration))
        tell(
            f"{clock(s.seconds)}  path {s.iteration} of {of}: root off by {1000 * s.error_m:.0f} mm, "
            f"help {s.help_n:.0f} N, {100 * s.unhelped:.0f} % without, {left} to go"
        )

    return TrainingCallbacks(expert, cloned_round, first, failed, path)


def first_delivery(
    imitation: Imitation, out: Path, motion: Path | None = None, hold: bool = True
) -> First:
    """Writes the clone's motion, score and report, see `deliver`; training then betters them."""

    def deliver_first(policy: PolicyBundle, start: WarmStart) -> None:
        from poise.jobs.deliver import deliver
        from poise.jobs.runs import evaluate
        from poise.jobs.warm_start import FIRST_STARTS

        meta = {"seconds": start.seconds, "samples": start.samples}
        evaluation = evaluate(imitation, policy, meta, most=FIRST_STARTS)
        paths = deliver(imitation, evaluation, out, {}, motion, hold).paths
        tell(f"first result: {summary(evaluation.card)}; see {paths['report']}")

    return deliver_first


def summary(card: ScoreCard) -> str:
    """A score card in half a line: "succ 97 %, 19 mm, help 69 N and 28 N m"."""
    aid = card.help
    return (
        f"succ {100 * card.succ:.0f} %, {card.mpjpe_mm:.0f} mm, "
        f"help {aid.force_mean_n:.0f} N and {aid.torque_mean_nm:.0f} N m"
    )
