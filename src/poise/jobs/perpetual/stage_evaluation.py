"""Evaluations of a stage, and whether it goes on."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from poise.eval import ClipResults, RecoveryCard
from poise.eval.recovery import KINDS
from poise.jobs.perpetual.evaluation import History, back, evaluate_clips, try_recovery
from poise.jobs.perpetual.stage_initialisation import staged
from poise.jobs.perpetual.stage_order import Stage
from poise.jobs.perpetual.stage_record import StageRecord, mean_help
from poise.learn import Decision, PolicyBundle
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual


@dataclass(frozen=True, eq=False)
class Judged:
    """What an evaluation saw and says: every clip of the stage, trials of recovery, or both."""

    decision: Decision
    clips: ClipResults | None
    recovery: RecoveryCard | None

    def row(self) -> dict[str, float]:
        """For the log."""
        row: dict[str, float] = {}
        if (r := self.clips) is not None:
            row = {"eval/clips": len(r.clip), "eval/succeeded": int(r.succeeded.sum())}
            row["eval/mpjpe_global_mm"] = r.error_mm
        if self.recovery is not None:
            won, tried = back(self.recovery)
            row |= {"eval/trials": tried, "eval/recovered": won}
        return row


def help_of_clips(imitation: Imitation, scale: float | Tensor, most: bool = False) -> float | Tensor:
    """What each clip of the library has left on average, or at most, `(C,)`.

    scale: that of its motion bins `(G,)`, of clips `(C,)`, or the one that all have.
    """
    if not isinstance(scale, Tensor) or imitation.config.help_by != "bin":
        return scale
    return imitation.reference.bins.by_clip(scale, most)


class Judge:
    """Evaluates the policies of a run's stages and notes it in the stage record and the history."""

    def __init__(
        self,
        imitation: Imitation,
        stage_record: StageRecord,
        history: History,
        threads: int,
        device: str,
    ):
        self.imitation, self.stage_record, self.history = imitation, stage_record, history
        self.config: Perpetual = imitation.config
        self.where = (threads, device)

    def every(self, stage: Stage, samples: int) -> int:
        """Iterations of so many control steps between evaluations of a stage."""
        if self.config.evaluate_every:
            return self.config.evaluate_every
        steps, plan = 0.0, self.config.recovering
        if stage.kind != "recovery":
            steps += int(self.imitation.reference.length.cpu()[self.stage_record.mining.member].sum())
        if stage.recovers is not None:
            steps += len(KINDS) * plan.trials * max(plan.seconds) * self.config.sim.control_hz
        return max(25, round(10 * steps / samples))

    def judge(
        self, stage: Stage, policy: PolicyBundle, scale: float | Tensor, over: bool, iteration: int
    ) -> Judged:
        """Evaluates the stage's clips, or trials of recovery, and decides.

        A stage ends by what is done without help: where an evaluation with what is left of it finds that
        nothing is gained any more, another one without decides what is solved and what the next stage
        is to learn.

        Args:
            scale: of the help that is left, of all or of each clip or motion bin of the library.
            over: the stage's time is over.
        """
        if stage.kind == "recovery":
            return self._recovery(stage, policy, over)
        clips, card = self._both(stage, policy, scale, iteration)
        by_clip = help_of_clips(self.imitation, scale)
        decision = self.stage_record.decide(by_clip)
        if over and decision == "go on":
            decision = "next"
        if decision == "next" and mean_help(by_clip, self.stage_record.clips) > 0:
            clips, card = self._both(stage, policy, 0.0, iteration)
            decision = "solved" if bool(clips.succeeded.all()) else "next"
        if card is not None and decision == "solved" and not self._enough(card):
            decision = "next"
        return Judged(decision, clips, card)

    def _recovery(self, stage: Stage, policy: PolicyBundle, over: bool) -> Judged:
        """Getting up is learned late and all at once, so that only success ends the stage, or time."""
        card = self.trials(stage, policy, self.config.recovering.trials)
        self.stage_record.record_trials(card, policy)
        ended: Decision = "solved" if self._enough(card) else "next"
        return Judged(ended if over or ended == "solved" else "go on", None, card)

    def _both(
        self, stage: Stage, policy: PolicyBundle, scale: float | Tensor, iteration: int
    ) -> tuple[ClipResults, RecoveryCard | None]:
        own, clips = staged(self.imitation, stage), self.stage_record.clips
        starts, card, recovered = self.config.starts, None, 0.0
        results = evaluate_clips(own, policy, clips, scale, *self.where, starts=starts)
        if stage.mixed:
            card = self.trials(stage, policy, self.config.recovering.trials)
            won, tried = back(card)
            recovered = won / tried
        self.stage_record.record(results, policy, help_of_clips(self.imitation, scale), recovered)
        most = help_of_clips(self.imitation, scale, most=True) * self.config.help_start
        self.history.add(iteration, stage.name, most, results)
        return results, card

    def trials(self, stage: Stage, policy: PolicyBundle, count: int) -> RecoveryCard:
        """Trials of recovery in a stage that learns it."""
        return try_recovery(staged(self.imitation, stage), policy, count, *self.where)

    def _enough(self, card: RecoveryCard) -> bool:
        won, tried = back(card)
        return won >= self.config.recovering.enough * tried
