"""The stage machine: what is trained, when a stage ends, and what comes next, all by itself.

    primitive 1 on all clips -> primitive k on what still fails -> composer on all clips

(or `single`: one network on all clips). A checkpoint is the whole machine between two iterations; a new
stage replaces the checkpoint of the last one in one step, so that a run that was killed anywhere goes on
as if nothing had happened.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from poise.env import ImitationEnv
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
from poise.learn.checkpoint import remove_partial
from poise.learn.state import make_generator, prefixed, under
from poise.recipes.expert import Beginning
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import Perpetual
from poise.recipes.perpetual_eval import ClipResults, History, evaluate_clips
from poise.recipes.perpetual_ledger import Ledger
from poise.recipes.perpetual_next import (
    begin_composer,
    begin_first,
    begin_primitive,
    critic_of,
    make_trainer,
)
from poise.recipes.perpetual_progress import Progress, Stage, share_of
from poise.sim import UnstableError

#: Simulations that may go bad between two evaluations.
MOST_TROUBLES = 5


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
        self.tensorboard = tensorboard
        self.dumps, self.tell = folder / "dumps", tell or Beginning()
        self.ledger = Ledger(self.config, imitation.reference.length)
        self.finished, self.before, self.begun = False, 0, (0, 0.0)
        # How often a simulation went bad in all, and since the last evaluation.
        self.troubles = (0, 0)
        if (folder / LATEST).exists():
            self._load()
            remove_partial(folder)
        else:
            stage, start = begin_first(imitation, threads, self.dumps, self.tell)
            warm = start is not None and start.critic is not None
            self._enter(stage, start, warm, 1.0)
            # What the clone has cost is no time with help.
            self.begun = self.trainer.samples, self.trainer.seconds
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
        frames = int(self.imitation.reference.length.cpu()[self.ledger.mining.member].sum())
        return max(25, round(10 * frames / self.trainer.rollout.samples))

    def policy(self) -> PolicyBundle:
        """The stage's policy that did best, or the present one before any was evaluated."""
        policy = self.trainer.policy()
        if self.ledger.best:
            policy.load_state(self.ledger.best)
        return policy

    # --- training -----------------------------------------------------------------------------

    def iterate(self) -> Progress:
        """One iteration, with the evaluation, the next stage and the checkpoint that are due."""
        stage, results, following = self.stage, None, None
        self._limit_help()
        stats, trouble = self._learn()
        self._limit_help()
        iteration, share, help_n = self.iteration, self.share, self.help * self.config.help_start
        row = stats.row() | {"iteration": iteration, "stage": stage.number}
        seen = self.ledger.seen
        if share >= self.until_share or self.trainer.iteration % self.every == 0:
            results, decision = self._judge(share)
            self.troubles = (self.troubles[0], 0)
            seen = self.ledger.seen
            row |= {
                "eval/clips": len(results.clip),
                "eval/succeeded": int(results.succeeded.sum()),
                "eval/mpjpe_global_mm": results.error_mm,
            }
            following = None if decision == "go on" else self._advance(decision)
        self.log.write(row)
        if results is not None or time.monotonic() - self._saved_at >= self.save_s:
            self.save()
        return Progress(stage, iteration, stats, share, *seen, help_n, results, following, trouble)

    def _learn(self) -> tuple[IterationStats, str]:
        """One iteration, and what went wrong before it.

        Where a simulation goes bad, as one world in millions of steps may do, training goes on from the
        last checkpoint with other draws, since the same ones would end there again.

        Raises:
            UnstableError: it happens again and again.
        """
        trouble = ""
        while True:
            try:
                return self.trainer.iterate(), trouble
            except UnstableError as problem:
                total, lately = self.troubles
                if lately >= MOST_TROUBLES:
                    raise
                trouble, self.troubles = str(problem), (total + 1, lately + 1)
                self.trainer.load(self.folder / LATEST)
                self.log.close()
                self.log = Log(self.folder, self.iteration, self.tensorboard)
                other, noise = f"after trouble {total + 1}", self.trainer.ppo.noise
                draws = make_generator(self.config.seed, other, noise.device)
                noise.set_state(draws.get_state())
                self.env.reseed(int(draws.initial_seed()))
                self.save()

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
        scale, over = self.help, share >= self.until_share
        results = self._evaluate(scale)
        decision = self.ledger.decide(scale)
        if over and decision == "go on":
            decision = "next"
        if decision == "next" and scale > 0:
            results = self._evaluate(0.0)
            decision = "solved" if bool(results.succeeded.all()) else "next"
        ends = decision == "solved" and (self.lasts or self.stage.number == 1)
        # Without any time left nothing begins, and the last stage has all the time there is.
        return results, decision if ends or not (self.lasts or share >= 1) else "go on"

    def _evaluate(self, scale: float) -> ClipResults:
        policy = self.trainer.policy()
        where = (self.threads, self.device)
        results = evaluate_clips(self.imitation, policy, self.ledger.clips, scale, *where)
        self.ledger.record(results, policy, scale)
        self.env.weights = self.ledger.mining.weights()
        self.history.add(self.iteration, self.stage.name, scale * self.config.help_start, results)
        return results

    # --- stages -------------------------------------------------------------------------------

    def _advance(self, decision: Decision) -> Stage | None:
        """Ends the stage; the next one, or None where there is none."""
        stage, ledger, t = self.stage, self.ledger, self.trainer
        if self.lasts:
            self.finished = True
            return None
        member, policy = ledger.mining.member.clone(), self.policy()
        hard = torch.zeros_like(member) if decision == "solved" else ledger.hard
        ledger.owner[member] = stage.number - 1
        about = {"stage": stage.name, "clips": int(member.sum()), "hard": int(hard.sum())}
        policy.save(self.folder / f"primitive-{stage.number}.safetensors", t.character, about)
        if not bool(hard.any()) and stage.number == 1:
            self.finished = True
            return None
        before = WarmStart(policy, critic_of(t), t.samples, t.seconds)
        if bool(hard.any()) and stage.number < self.config.max_primitives:
            following, scale = Stage("primitive", stage.number + 1), self.help
            start = begin_primitive(before, self.config, following.number)
        else:
            following, scale, hard = Stage("composer", stage.number + 1), 0.0, torch.ones_like(member)
            where = (self.threads, self.dumps, self.tell)
            start = begin_composer(before, self.imitation, ledger.owner, *where)
        self.before, self.begun = self.iteration, (start.samples, start.seconds)
        self.env.close()
        ledger.begin(hard)
        self._enter(following, start, True, scale)
        if isinstance(self.trainer.style, Amp) and isinstance(t.style, Amp):
            # The discriminator goes on, as in the paper.
            self.trainer.style.load_learned(t.style.state())
        return following

    def _enter(self, stage: Stage, start: WarmStart | None, warm: bool, scale: float) -> None:
        """Makes the stage's trainer, whose worlds have the share `scale` of the help."""
        self.stage, self.warm = stage, warm
        where = (self.threads, self.dumps, self.device)
        self.trainer: Trainer = make_trainer(self.imitation, stage, start, warm, *where)
        self.env.help.set(scale)
        self.env.weights = self.ledger.mining.weights()

    # --- persistence --------------------------------------------------------------------------

    def save(self) -> None:
        """Writes the checkpoint: the trainer and everything that decides what comes next."""
        self.log.flush()
        self.trainer.metadata["course"] = {
            "stage": asdict(self.stage), "warm": self.warm, "before": self.before,
            "begun": list(self.begun), "troubles": list(self.troubles),
            "finished": self.finished, "ledger": self.ledger.facts(),
        }  # fmt: skip
        self.trainer.save(self.folder / LATEST, prefixed("ledger", self.ledger.state()))
        self._saved_at = time.monotonic()

    def _load(self) -> None:
        path = self.folder / LATEST
        tensors, meta = load_checkpoint(path)
        said: dict[str, Any] = meta["metadata"]["course"]
        self.ledger.load(under("ledger", tensors), said["ledger"])
        samples, seconds = said["begun"]
        self.before, self.begun, self.finished = said["before"], (samples, seconds), said["finished"]
        total, lately = said["troubles"]
        self.troubles = (total, lately)
        # A trainer takes the sizes and the action noise from the policy it starts with.
        start = WarmStart(load_policy(path))
        self._enter(Stage(**said["stage"]), start, said["warm"], 1.0)
        self.trainer.load(path)

    def close(self) -> None:
        """Frees the worlds and closes the log."""
        self.log.close()
        self.env.close()
