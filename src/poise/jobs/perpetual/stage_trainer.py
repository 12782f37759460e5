"""The stage machine: a library's training goes from stage to stage by itself, as evaluations decide.

A `StageOrder` says which stage follows which and how one begins. A checkpoint is the whole machine
between two iterations. A new stage replaces the checkpoint of the last one in one step, so that a run
that was killed anywhere goes on as if nothing had happened.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.jobs.perpetual.evaluation import (
    EvaluationLog,
    StageRecord,
    back,
    check_falls,
    evaluate_clips,
    mean_help,
    try_recovery,
)
from poise.jobs.perpetual.stages import DUMPS, Progress, Stage, critic_of, odds, order_of, staged
from poise.jobs.warm_start import TrainingCallbacks
from poise.learn import (
    LATEST,
    Amp,
    Decision,
    IterationStats,
    Log,
    PolicyBundle,
    Trainer,
    Until,
    WarmStart,
    load_checkpoint,
    load_policy,
)
from poise.learn.checkpoint import make_generator, prefixed, remove_partial, under
from poise.plan import LookaheadTeacher
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual_settings import Perpetual
from poise.score import ClipResults, RecoveryCard
from poise.score.recovered import KINDS
from poise.sim import UnstableError


@dataclass(frozen=True, eq=False)
class StageVerdict:
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
        history: EvaluationLog,
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
    ) -> StageVerdict:
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
        return StageVerdict(decision, clips, card)

    def _recovery(self, stage: Stage, policy: PolicyBundle, over: bool) -> StageVerdict:
        """Getting up is learned late and all at once, so that only success ends the stage, or time."""
        card = self.trials(stage, policy, self.config.recovering.trials)
        self.stage_record.record_trials(card, policy)
        ended: Decision = "solved" if self._enough(card) else "next"
        return StageVerdict(ended if over or ended == "solved" else "go on", None, card)

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


#: Times that writing a checkpoint takes, after which the next may be written.
SAVES = 50.0
#: Simulations that may go bad between two evaluations.
MOST_TROUBLES = 5


class StageTrainer:
    """A library's training in a run folder; begins it, or goes on from its checkpoint.

    until: limits of the whole training, of which every stage has its part. save_s: seconds between two
    checkpoints, beside those after evaluations; 0 saves after every iteration, and None as often as
    that takes a fiftieth of the time at most (`SAVES`), which is after every iteration but for short
    ones. trained: a policy that a new run goes on from.
    """

    def __init__(
        self,
        imitation: Imitation,
        folder: Path,
        until: Until,
        threads: int = 0,
        device: str = "cpu",
        tensorboard: bool = True,
        tell: TrainingCallbacks | None = None,
        save_s: float | None = None,
        trained: PolicyBundle | WarmStart | None = None,
    ):
        self.imitation, self.folder, self.until = imitation, folder, until
        self.config: Perpetual = imitation.config
        self.order = order_of(self.config)
        self.threads, self.device, self.save_s = threads, device, save_s
        self.tensorboard = tensorboard
        self.dumps, self.tell = folder / DUMPS, tell or TrainingCallbacks()
        self.stage_record = StageRecord(self.config, imitation.reference.length)
        self.finished, self.before, self.begun = False, 0, (0, 0.0)
        # How often a simulation went bad in all, and since the last evaluation.
        self.troubles = [0, 0]
        if (folder / LATEST).exists():
            self._load()
            remove_partial(folder)
        else:
            check_falls(imitation)
            stage, start = self.order.begin(imitation, threads, folder, self.tell, trained)
            warm = start is not None and (start.critic is not None or trained is not None)
            if stage.kind == "recovery":
                self.stage_record.begin(self.order.members(stage, torch.zeros(0), imitation))
            self._enter(stage, start, warm, 1.0)
            # What the clone has cost is no time with help.
            self.begun = self.trainer.samples, self.trainer.seconds
        self.history = EvaluationLog(folder, imitation.library.names, self.iteration)
        self.judge = Judge(imitation, self.stage_record, self.history, threads, device)
        self.log = Log(folder, self.iteration, tensorboard)
        self._saved_at, self._save_took = time.monotonic(), 0.0
        if not (folder / LATEST).exists():
            if trained is not None and self.order.given_first:
                # It is the first primitive as it is: what it fails is for the next one.
                self._advance(self._judge(over=True))
            self.save()

    # --- where it stands ----------------------------------------------------------------------

    @property
    def env(self) -> ImitationEnv:
        """The stage's worlds."""
        env = self.trainer.env
        assert isinstance(env, ImitationEnv)
        return env

    @property
    def iteration(self) -> int:
        """Iterations of all stages."""
        return self.before + self.trainer.iteration

    @property
    def share(self) -> float:
        """How much of the whole training is done, 0 to 1."""
        return self.until.done(self.iteration, self.trainer.samples, self.trainer.seconds)

    @property
    def help(self) -> float:
        """What is left of the residual force's limits, 0 to 1, where most is left."""
        return self.env.help.now if self.imitation.task.residual is not None else 0.0

    @property
    def helps(self) -> float | Tensor:
        """What is left of it in each group of `Perpetual.help_by`, or a number for all."""
        if self.imitation.task.residual is None or self.stage.recovers is not None:
            return 0.0
        return self.env.help.left

    @property
    def primitives(self) -> int:
        """Primitives of tracking that were begun; 0 for a network that learns all clips at once."""
        return self.order.primitives(self.stage)

    @property
    def recovers(self) -> bool:
        """Whether the stage's policy learned to recover."""
        given = self.order.given_first and self.stage.number == 1
        return given or self.stage.recovers is not None

    @property
    def began(self) -> float:
        """The share of the whole training at which this stage began."""
        return self.until.done(self.before, *self.begun)

    def policy(self) -> PolicyBundle:
        """The stage's policy that did best, or the present one before any was evaluated."""
        policy = self.trainer.policy()
        if self.stage_record.best:
            policy.load_state(self.stage_record.best)
        return policy

    # --- training -----------------------------------------------------------------------------

    def iterate(self) -> Progress:
        """One iteration, with the evaluation, the next stage and the checkpoint that are due."""
        stage, judged, follows = self.stage, None, None
        self._limit_help()
        self._cool()
        stats, trouble = self._iterated()
        self._limit_help()
        iteration, share, help_n = self.iteration, self.share, self.help * self.config.help_start
        row = stats.row() | {"iteration": iteration, "stage": stage.number}
        seen = self.stage_record.seen
        every = self.judge.every(stage, self.trainer.rollout.samples)
        over = share >= self.order.ends(stage, self.began)
        if over or self.trainer.iteration % every == 0:
            judged = self._judge(over)
            self.troubles[1] = 0
            seen = self.stage_record.seen
            row |= judged.row()
            if self.order.is_over(stage, judged.decision, share):
                follows = self._advance(judged)
        self.log.write(row)
        due = SAVES * self._save_took if self.save_s is None else self.save_s
        if judged is not None or time.monotonic() - self._saved_at >= due:
            self.save()
        results, card = (judged.clips, judged.recovery) if judged is not None else (None, None)
        shown = (help_n, results, card, follows, trouble)
        return Progress(stage, iteration, stats, share, *seen, *shown)

    def _iterated(self) -> tuple[IterationStats, str]:
        """One iteration, and what went wrong before it: training goes on where a simulation goes bad, as
        one world in millions of steps may do.

        Raises:
            UnstableError: it happens again and again.
        """
        trouble = ""
        while True:
            try:
                return self.trainer.iterate(), trouble
            except UnstableError as problem:
                if self.troubles[1] >= MOST_TROUBLES:
                    raise
                trouble = str(problem)
                self.troubles = [n + 1 for n in self.troubles]
                self._go_back(self.troubles[0])

    def _go_back(self, trouble: int) -> None:
        """To the last checkpoint, and on with other draws, since the same ones would end there again."""
        self.trainer.load(self.folder / LATEST)
        self.log.close()
        self.log = Log(self.folder, self.iteration, self.tensorboard)
        noise = self.trainer.ppo.noise
        draws = make_generator(self.config.seed, f"after trouble {trouble}", noise.device)
        noise.set_state(draws.get_state())
        self.env.reseed(int(draws.initial_seed()))
        self.save()

    def _limit_help(self) -> None:
        """No more help, on any clip, than the stage's time allows."""
        if self.imitation.task.residual is None:
            return
        most = self.order.most_help(self.stage, self.began, self.share)
        if most == 0.0:
            self.env.help.schedule = None
        self.env.help.cap(most)

    def _cool(self) -> None:
        """Smaller steps towards the stage's end, see `Perpetual.cooling`."""
        cooling, end = self.config.cooling, self.order.ends(self.stage, self.began)
        if cooling and end > self.began:
            left = (end - self.share) / (end - self.began)
            self.trainer.ppo.cool(left, cooling)

    def _judge(self, over: bool) -> StageVerdict:
        """Evaluates the present policy. over: the stage's time is."""
        judged = self.judge.judge(self.stage, self.trainer.policy(), self.helps, over, self.iteration)
        self._use_odds()
        return judged

    # --- stages -------------------------------------------------------------------------------

    def _advance(self, judged: StageVerdict) -> Stage | None:
        """Ends the stage; the next one, or None where there is none."""
        stage, stage_record, t = self.stage, self.stage_record, self.trainer
        member, policy = stage_record.mining.member.clone(), self.policy()
        hard = torch.zeros_like(member) if judged.decision == "solved" else stage_record.hard
        follows = self.order.following(stage, bool(hard.any()))
        if stage.kind == "primitive":
            stage_record.owner[member] = stage.number - 1
        if stage.kind in ("primitive", "recovery") and not self.order.lasts(stage):
            about = {"stage": stage.name, "clips": int(member.sum()), "hard": int(hard.sum())}
            name = stage.name.replace(" ", "-")
            policy.save(self.folder / f"{name}.safetensors", t.character, about)
        if follows is None:
            self.finished = True
            return None
        before = WarmStart(policy, critic_of(t), t.samples, t.seconds)
        where = (self.threads, self.dumps, self.tell)
        start = self.order.next(before, self.imitation, follows, stage_record.owner, *where)
        # A composer and what recovers learn without help; a primitive's clips keep what they have.
        scale = self.helps if follows.kind == "primitive" else 0.0
        self.before, self.begun = self.iteration, (start.samples, start.seconds)
        self.trainer.close()
        stage_record.begin(self.order.members(follows, hard, self.imitation))
        self._enter(follows, start, True, scale)
        if isinstance(self.trainer.style, Amp) and isinstance(t.style, Amp):
            # The discriminator goes on, as in the paper.
            self.trainer.style.load_learned(t.style.state())
        return follows

    def _enter(self, stage: Stage, start: WarmStart | None, warm: bool, scale: float | Tensor) -> None:
        """Makes the stage's trainer, with the share `scale` of the help, or each group's own `(G,)`."""
        self.stage, self.warm = stage, warm
        where = (self.threads, self.dumps, self.device)
        self.trainer: Trainer = self.order.trainer(self.imitation, stage, start, warm, *where)
        self.env.help.set(scale)
        self._use_odds()

    def _use_odds(self) -> None:
        """Clips are drawn by what is known of them."""
        library, length = self.stage_record.mining.weights(), self.env.reference.length
        self.env.weights = odds(self.imitation, self.stage, library, length)
        student = self.trainer.student
        if student is not None and isinstance(student.lessons, LookaheadTeacher):
            student.lessons.env.weights = self.env.weights

    # --- persistence --------------------------------------------------------------------------

    def save(self) -> None:
        """Writes the checkpoint: the trainer and everything that decides what comes next."""
        began = time.monotonic()
        self.log.flush()
        self.trainer.metadata["course"] = {
            "stage": asdict(self.stage), "warm": self.warm, "before": self.before,
            "begun": list(self.begun), "troubles": self.troubles,
            "finished": self.finished, "ledger": self.stage_record.facts(),
        }  # fmt: skip
        self.trainer.save(self.folder / LATEST, prefixed("ledger", self.stage_record.state()))
        self._saved_at = time.monotonic()
        self._save_took = self._saved_at - began

    def _load(self) -> None:
        path = self.folder / LATEST
        tensors, meta = load_checkpoint(path)
        said: dict[str, Any] = meta["metadata"]["course"]
        self.stage_record.load(under("ledger", tensors), said["ledger"])
        samples, seconds = said["begun"]
        self.before, self.begun, self.finished = said["before"], (samples, seconds), said["finished"]
        self.troubles = list(said["troubles"])
        # A trainer takes the sizes and the action noise from the policy it starts with.
        start = WarmStart(load_policy(path))
        self._enter(Stage(**said["stage"]), start, said["warm"], 1.0)
        self.trainer.load(path)

    def close(self) -> None:
        """Frees the worlds and closes the log."""
        self.log.close()
        self.trainer.close()
