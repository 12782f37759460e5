"""The stage machine: what is trained, when a stage ends, and what comes next, all by itself.

    primitive 1 on all clips -> primitive k on what still fails -> composer on all clips

(or `single`: one network on all clips). A checkpoint is the whole machine between two iterations; a new
stage replaces the checkpoint of the last one in one step, so that a run that was killed anywhere goes on
as if nothing had happened.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from poise.env import ImitationEnv
from poise.learn import (
    LATEST,
    Convergence,
    Decision,
    HardNegatives,
    IterationStats,
    Log,
    PolicyBundle,
    Trainer,
    Until,
    WarmStart,
    load_checkpoint,
)
from poise.learn.checkpoint import remove_partial
from poise.learn.state import State, prefixed, take, under
from poise.recipes.expert import Beginning
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import Perpetual
from poise.recipes.perpetual_eval import ClipResults, History, evaluate_clips
from poise.recipes.perpetual_next import (
    Stage,
    begin_composer,
    begin_first,
    begin_primitive,
    critic_of,
    make_trainer,
)

#: Help that is less by this share of its limit is a gain of a stage.
LESS_HELP = 0.01


@dataclass(frozen=True)
class Progress:
    """What one iteration came to.

    stage: the one that was trained, of whose `clips` the last evaluation saw `succeeded`, or None before
    the first. iteration: over all stages. share: of the whole training, 0 to 1. help_n: N, what is left.
    results: an evaluation that was made after this iteration. following: the stage that begins now.
    """

    stage: Stage
    iteration: int
    stats: IterationStats
    share: float
    succeeded: int | None
    clips: int
    help_n: float
    results: ClipResults | None
    following: Stage | None


def share_of(until: Until, iterations: int, samples: int, seconds: float) -> float:
    """How much of the nearest limit is used up, 0 to 1."""
    used = (
        (seconds / 60, until.minutes), (iterations, until.iterations), (samples, until.samples)
    )  # fmt: skip
    return min(1.0, max(a / b if b else 1.0 for a, b in used if b is not None))


class Course:
    """A library's training in a run folder; begins it, or goes on from its checkpoint.

    until: limits of the whole training, of which every stage has its part. save_s: seconds between two
    checkpoints, beside those after evaluations; 0 saves after every iteration.
    """

    def __init__(
        self,
        imitation: Imitation,
        folder: Path,
        until: Until,
        threads: int = 0,
        device: str = "cpu",
        tensorboard: bool = True,
        tell: Beginning | None = None,
        save_s: float = 30.0,
    ):
        self.imitation, self.folder, self.until = imitation, folder, until
        self.config: Perpetual = imitation.config
        self.threads, self.device, self.save_s = threads, device, save_s
        self.dumps, self.tell = folder / "dumps", tell or Beginning()
        length = imitation.reference.length.cpu()
        self.mining = HardNegatives(len(length), self.config.mining, (length - 1).double())
        self.convergence = Convergence(self.config.convergence)
        # The primitive that learned each clip.
        self.owner = torch.zeros(len(length), dtype=torch.long)
        self.finished = False
        # Clips that succeeded in the last evaluation, and how many the stage has.
        self._seen: tuple[int | None, int] = (None, len(length))
        self._reset(0, (0, 0.0))
        if (folder / LATEST).exists():
            self._load()
            remove_partial(folder)
        else:
            stage, start = begin_first(imitation, threads, self.dumps, self.tell)
            warm = start is not None and start.critic is not None
            self._enter(stage, start, warm, 1.0)
        self.history = History(folder, imitation.library.names, self.iteration)
        self.log = Log(folder, self.iteration, tensorboard)
        self._saved_at = time.monotonic()
        if not (folder / LATEST).exists():
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
        return share_of(self.until, self.iteration, self.trainer.samples, self.trainer.seconds)

    @property
    def help(self) -> float:
        """What is left of the residual force's limits, 0 to 1."""
        return self.env.help.now if self.imitation.task.residual is not None else 0.0

    @property
    def primitives(self) -> int:
        """Primitives that were begun; 0 for the single network."""
        return self.stage.number - (self.stage.kind != "primitive")

    @property
    def lasts(self) -> bool:
        """Whether no stage follows, so that this one has all the time that is left."""
        return self.stage.kind != "primitive" or self.config.max_primitives == 1

    @property
    def until_share(self) -> float:
        """The share of the whole training at which this stage ends at the latest."""
        if self.lasts:
            return 1.0
        (first, last), n = self.config.shares, self.config.max_primitives
        return first + (last - first) * (self.stage.number - 1) / max(1, n - 1)

    @property
    def every(self) -> int:
        """Iterations between evaluations of this stage's clips."""
        if self.config.evaluate_every:
            return self.config.evaluate_every
        frames = int(self.imitation.reference.length.cpu()[self.mining.member].sum())
        return max(25, round(10 * frames / self.trainer.rollout.samples))

    def policy(self) -> PolicyBundle:
        """The stage's policy that did best, or the present one before any was evaluated."""
        policy = self.trainer.policy()
        if self.best:
            policy.load_state(self.best)
        return policy

    # --- training -----------------------------------------------------------------------------

    def iterate(self) -> Progress:
        """One iteration, with the evaluation, the next stage and the checkpoint that are due."""
        stage, results, following = self.stage, None, None
        self._limit_help()
        stats = self.trainer.iterate()
        self._limit_help()
        iteration, share, help_n = self.iteration, self.share, self.help * self.config.help_start
        row = stats.row() | {"iteration": iteration, "stage": stage.number}
        if share >= min(1.0, self.until_share) or self.trainer.iteration % self.every == 0:
            results, decision = self._judge(share)
            row |= {
                "eval/clips": len(results.clip),
                "eval/succeeded": int(results.succeeded.sum()),
                "eval/mpjpe_global_mm": results.error_mm,
            }
        self.log.write(row)
        shown = self._seen
        if results is not None and decision != "go on":
            following = self._advance(decision)
        if results is not None or time.monotonic() - self._saved_at >= self.save_s:
            self.save()
        return Progress(stage, iteration, stats, share, *shown, help_n, results, following)

    def _limit_help(self) -> None:
        """No more help than the stage's time allows, so that it ends in any case."""
        if self.imitation.task.residual is None:
            return
        begun = share_of(self.until, self.before, *self.begun)
        span = max(1e-9, self.until_share - begun) * self.config.help_share
        most = min(1.0, max(0.0, 1.0 - (self.share - begun) / span))
        if most == 0.0:
            self.env.help.schedule = None
        if self.help > most:
            self.env.help.set(most)

    def _judge(self, share: float) -> tuple[ClipResults, Decision]:
        """Evaluates the stage's clips and decides; a stage ends by what is done without help."""
        scale, least = self.help, self.least
        results = self._evaluate(scale)
        self.least = min(least, scale)
        improved = scale < least - LESS_HELP
        decision = self.convergence.add(int(results.succeeded.sum()), len(results.clip), improved)
        over = share >= self.until_share
        if decision == "solved" and scale > 0 and not over:
            decision = "go on"
        if over and decision == "go on":
            decision = "next"
        if decision != "go on" and scale > 0:
            results = self._evaluate(0.0)
            decision = "solved" if bool(results.succeeded.all()) else "next"
        ends = decision == "solved" and (self.lasts or self.stage.number == 1)
        # Without any time left nothing begins, and the last stage has all the time there is.
        return results, decision if ends or not (self.lasts or share >= 1) else "go on"

    def _evaluate(self, scale: float) -> ClipResults:
        member = self.mining.member
        results = evaluate_clips(
            self.imitation, self.trainer.policy(), member.nonzero().squeeze(-1), scale, self.threads,
            self.device,
        )  # fmt: skip
        won = results.spread(results.succeeded, len(member))
        self.mining.record(won, member)
        self._set_weights()
        self._seen = (int(won.sum()), len(results.clip))
        self.history.add(self.iteration, self.stage.name, scale * self.config.help_start, results)
        # Less help counts before more clips, more clips before a smaller error.
        key = (-scale, results.rate, -results.error_mm)
        if not self.best or key > self.best_key:
            self.best, self.best_key = self.trainer.policy().state(), key
            self.best_failed = member & ~won
        return results

    # --- stages -------------------------------------------------------------------------------

    def _advance(self, decision: Decision) -> Stage | None:
        """Ends the stage; the next one, or None where there is none."""
        stage, mining, config = self.stage, self.mining, self.config
        if self.lasts:
            self.finished = True
            return None
        member = mining.member.clone()
        hard = torch.zeros_like(member) if decision == "solved" else (mining.hard | self.best_failed)
        self.owner[member] = stage.number - 1
        policy = self.policy()
        about = {"stage": stage.name, "clips": int(member.sum()), "hard": int(hard.sum())}
        policy.save(
            self.folder / f"primitive-{stage.number}.safetensors", self.trainer.character, about
        )
        if not bool(hard.any()) and stage.number == 1:
            self.finished = True
            return None
        t = self.trainer
        before = WarmStart(policy, critic_of(t), t.samples, t.seconds)
        scale, done = self.help, self.iteration
        if bool(hard.any()) and stage.number < config.max_primitives:
            following = Stage("primitive", stage.number + 1)
            start = begin_primitive(before, config, following.number)
            mining.next_stage(hard)
        else:
            following, scale = Stage("composer", stage.number + 1), 0.0
            start = begin_composer(
                before, self.imitation, self.owner, self.threads, self.dumps, self.tell
            )
            mining.next_stage(torch.ones_like(member))
        self.env.close()
        self.convergence.reset()
        self._reset(done, (start.samples, start.seconds))
        self._enter(following, start, True, scale)
        self._seen = (None, int(mining.member.sum()))
        return following

    def _reset(self, before: int, begun: tuple[int, float]) -> None:
        """What is counted per stage. before: iterations of earlier ones. begun: samples, seconds then."""
        self.before, self.begun, self.least = before, begun, 1.0
        self.best: State = {}
        self.best_key: tuple[float, ...] = ()
        self.best_failed = torch.zeros(len(self.owner), dtype=torch.bool)

    def _enter(self, stage: Stage, start: WarmStart | None, warm: bool, scale: float) -> None:
        self.stage, self.warm = stage, warm
        where = (self.threads, self.dumps, self.device)
        self.trainer: Trainer = make_trainer(self.imitation, stage, start, warm, *where)
        self.env.help.set(scale)
        self._set_weights()

    def _set_weights(self) -> None:
        self.env._weights = self.mining.weights()

    # --- persistence --------------------------------------------------------------------------

    def save(self) -> None:
        """Writes the checkpoint: the trainer and everything that decides what comes next."""
        self.log.flush()
        self.trainer.metadata["course"] = {
            "stage": asdict(self.stage), "warm": self.warm, "before": self.before,
            "begun": list(self.begun), "least": self.least, "best_key": list(self.best_key),
            "seen": list(self._seen), "finished": self.finished,
        }  # fmt: skip
        extra = prefixed("mining", self.mining.state()) | prefixed("stages", self.convergence.state())
        extra |= {"stages/owner": self.owner, "stages/best_failed": self.best_failed}
        self.trainer.save(self.folder / LATEST, extra | prefixed("best", self.best))
        self._saved_at = time.monotonic()

    def _load(self) -> None:
        tensors, meta = load_checkpoint(self.folder / LATEST)
        said: dict[str, Any] = meta["metadata"]["course"]
        self.mining.load_state(under("mining", tensors))
        self.convergence.load_state(under("stages", tensors))
        samples, seconds = said["begun"]
        self._reset(said["before"], (samples, seconds))
        self.owner, self.best_failed = (take(tensors, f"stages/{k}") for k in ("owner", "best_failed"))
        self.least, self.best_key = said["least"], tuple(said["best_key"])
        self.best, self.finished = under("best", tensors), said["finished"]
        succeeded, clips = said["seen"]
        self._seen = (succeeded, clips)
        stage, policy = Stage(**said["stage"]), meta["policy"]
        shaped = PolicyBundle.rebuild(meta["num_obs"], meta["num_actions"], policy)
        self._enter(stage, WarmStart(shaped), said["warm"], 1.0)
        self.trainer.load(self.folder / LATEST)

    def close(self) -> None:
        """Frees the worlds and closes the log."""
        self.log.close()
        self.env.close()
