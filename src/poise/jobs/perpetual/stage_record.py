"""What is known of a library's clips while it is learned: failures, owners, and the best policy."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil
from typing import Any

import torch
from torch import Tensor

from poise.eval import ClipResults, RecoveryCard
from poise.jobs.perpetual.evaluation import back
from poise.learn import Convergence, Decision, HardNegatives, PolicyBundle
from poise.learn.state import State, prefixed, take, under
from poise.recipes.perpetual.config import Perpetual

#: Help that is less by this share of its limit is a gain of a stage; less of a difference between the
#: means of clips that have help of their own is none.
LESS_HELP = 0.01
#: What a share of trials of recovery is worth beside the same share of clips, where both are learned.
RECOVERY_WORTH = 0.25


def mean_help(scale: float | Tensor, clips: Tensor) -> float:
    """The share of the help's limits that an evaluation of `clips (E,)` had: `scale`, or the mean of
    those of the clips, of the library's `(C,)`. It is 0 only where no clip had any."""
    return float(scale[clips].double().mean()) if isinstance(scale, Tensor) else scale


def _in_steps(scale: float) -> float:
    """Whole steps of `LESS_HELP`, counted up, so that a little help never passes for none."""
    # The mean of float32 scales, such as 0.3, may lie a hair above the step that is meant.
    return LESS_HELP * max(1, ceil(scale / LESS_HELP - 1e-4)) if scale > 0 else 0.0


class StageRecord:
    """The evaluations of a run; everything by which stages end and begin.

    Args:
        config: the recipe's settings.
        length: `(C,)` frames of the clips. Where none fails all are drawn alike but for those that are
            longer than an episode, by as much as they are: then each second is seen about as often.

    Attributes: `owner (C,)`, the primitive that learned each clip, from 0; `best`, the state of the
    stage's policy that did best, which had `best_failed (C,)`; `seen`, how many clips (trials of the
    recovery primitive) of how many succeeded in the last evaluation; `recovery`, the best trials of the
    recovery primitive as JSON data.
    """

    def __init__(self, config: Perpetual, length: Tensor):
        clips = len(length)
        base = (length.cpu() - 1).clamp(min=config.horizon).double()
        self.mining = HardNegatives(clips, config.mining, base)
        self.convergence = Convergence(config.convergence)
        self.owner = torch.zeros(clips, dtype=torch.long)
        self.recovery: dict[str, Any] | None = None
        self.begin(torch.ones(clips, dtype=torch.bool))

    def begin(self, member: Tensor) -> None:
        """Another stage, on the clips `member (C,)` bool; what is counted per stage begins anew."""
        self.mining.next_stage(member)
        self.convergence.reset()
        self.least = 1.0
        self.best: State = {}
        self.best_key: tuple[float, ...] = ()
        self.best_failed = torch.zeros_like(self.mining.member)
        self.seen: tuple[int | None, int] = (None, int(member.sum()))

    @property
    def clips(self) -> Tensor:
        """Indices of the stage's clips."""
        return self.mining.member.nonzero().squeeze(-1)

    @property
    def hard(self) -> Tensor:
        """`(C,)` bool, what the next primitive is to learn."""
        return self.mining.hard | self.best_failed

    def record(
        self,
        results: ClipResults,
        policy: PolicyBundle,
        scale: float | Tensor,
        recovered: float = 0.0,
    ) -> None:
        """Notes what `policy` did with the stage's clips, with the share `scale` of the help, or for
        each clip of the library its own `(C,)`.

        The best policy is the one with the least `mean_help`, of those the one with the most clips, of
        those the one with the most frames before a failure, of those the one with the smallest error.
        What was done without help counts before all that was not, and since a stage ends with an
        evaluation without, its best policy is of those. Which clips have help makes no difference; as
        the scales of clips go up and down each on its own, means are compared in steps of `LESS_HELP`.
        A clip that fails with the help that it has left counts as failed for mining and, unless a
        stage's end shows something else, for the next primitive.

        recovered: the share of its trials that were back, where the stage learns recovery, too.
        """
        member = self.mining.member
        won = results.spread(results.succeeded, len(member))
        self.mining.record(won, member)
        self.seen = (int(won.sum()), len(results.clip))
        # Less help counts before more clips, more clips before more frames and a smaller error.
        own = isinstance(scale, Tensor)
        left = _in_steps(mean_help(scale, results.clip)) if own else scale
        won_share = results.rate + RECOVERY_WORTH * recovered
        key = (-left, won_share, results.tracked_share, -results.error_mm)
        if not self.best or key > self.best_key:
            self.best, self.best_key, self.best_failed = policy.state(), key, member & ~won

    def record_trials(self, card: RecoveryCard, policy: PolicyBundle) -> None:
        """Notes what `policy` did with trials of recovery alone; of equals the later one is the best."""
        won, tried = self.seen = back(card)
        if not self.best or won / tried >= self.best_key[0]:
            self.best, self.best_key = policy.state(), (won / tried,)
            self.recovery = card.to_dict()

    def decide(self, scale: float | Tensor) -> Decision:
        """What the last evaluation says of the stage. scale: its share of the help, or `(C,)` of clips.

        A stage in which any clip has help is never solved; that its clips need less help, on average,
        is a gain.
        """
        scale = mean_help(scale, self.clips)
        succeeded, clips = self.seen
        assert succeeded is not None
        improved = scale < self.least - LESS_HELP
        self.least = min(self.least, scale)
        decision = self.convergence.add(succeeded, clips, improved)
        return "go on" if decision == "solved" and scale > 0 else decision

    def state(self) -> State:
        """Copies of all tensors."""
        own = {"owner": self.owner.clone(), "best_failed": self.best_failed.clone()}
        mining, convergence = prefixed("mining", self.mining.state()), self.convergence.state()
        return own | mining | convergence | prefixed("best", self.best)

    def facts(self) -> dict[str, Any]:
        """The rest of what `load` takes, as JSON data."""
        return {
            "least": self.least,
            "best_key": list(self.best_key),
            "seen": list(self.seen),
            "recovery": self.recovery,
        }

    def load(self, state: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
        """Goes on from `state` and `facts`."""
        self.mining.load_state(under("mining", state))
        self.convergence.load_state(state)
        self.owner, self.best_failed = take(state, "owner"), take(state, "best_failed")
        self.best, self.best_key = under("best", state), tuple(facts["best_key"])
        self.least = facts["least"]
        succeeded, clips = facts["seen"]
        self.seen = (succeeded, clips)
        self.recovery = facts.get("recovery")
