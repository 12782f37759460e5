"""Hard negative mining: clips that fail in evaluations are trained on more often.

Only numbers of clips are known here. After each evaluation `HardNegatives.record` notes which clips
succeeded, and `weights` are the odds with which an environment draws them.

`Convergence` says when a stage of training has learned what it can: its success no longer improves
(PHC, 3.2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.checkpoint import State, take
from poise.settings import Count, Share, validate

Rule = Literal["uniform", "soft", "hard", "floor"]
Union = Literal["recent", "last"]


@dataclass(frozen=True)
class MiningConfig:
    """How failures become odds; the default is ours, see `phc`."""

    rule: Rule = "floor"
    """With f_i how often clip i failed so far, and b_i the odds without mining:

    uniform: b_i, as PHC's paper trains a primitive on its hard set.
    soft: f_i; clips that never failed are never drawn (PHC's code). b_i while none has failed.
    hard: b_i of the clips that failed in the last evaluation, b_i of all while none did (PHC's code).
    floor: `floor` b_i + (1 - floor) e_i, where e_i is the share of failures of which old ones fade by
    `fade` per evaluation: every clip is drawn, and a clip that has been learned is left in peace.
    """
    floor: Share = 0.3
    """Share of the draws that are made as without mining."""
    fade: Share = 0.7
    """What an evaluation leaves of earlier failures with "floor"; 1 forgets none."""
    memory: Count = 5
    """With the union "recent", clips that failed in so many last evaluations are the next
    primitive's."""
    union: Union = "recent"
    """What the next primitive learns: clips that failed in any of the last `memory` evaluations (PHC's
    code), or in the last one (its paper)."""

    def __post_init__(self) -> None:
        validate(self)
        if self.rule == "floor" and self.floor == 0:
            raise PoiseError(
                "a floor of 0 is the rule soft",
                "MiningConfig",
                "Use soft, or a floor",
                code="settings-conflict",
            )

    @classmethod
    def phc(cls, faithful: Literal["paper", "code"] = "paper") -> MiningConfig:
        """PHC's paper trains each primitive evenly on what failed last; its code mines softly, on the
        union of five evaluations."""
        if faithful == "code":
            return cls(rule="soft", union="recent")
        return cls(rule="uniform", union="last")


class HardNegatives:
    """Which of C clips failed when, and what follows for training.

    Args:
        clips: C.
        config: the rules.
        base: `(C,)` odds without mining, such as the seconds of each clip; by default all the same, as
            in PHC's code.

    Attributes:
        member: `(C,)` bool, the clips of the present stage.
        tried: `(C,)`, number of evaluations.
        failed: `(C,)`, number of failed evaluations.
        faded: `(C,)`, failures of which old ones count less.
    """

    def __init__(self, clips: int, config: MiningConfig | None = None, base: Tensor | None = None):
        self.config = config or MiningConfig()
        self.base = torch.ones(clips, dtype=torch.float64) if base is None else base.double().cpu()
        if clips < 1 or self.base.shape != (clips,) or not bool((self.base > 0).all()):
            raise PoiseError(f"mining needs odds above 0 for each of {clips} clips", code="bad-weights")
        self.member = torch.ones(clips, dtype=torch.bool)
        self.tried = torch.zeros(clips, dtype=torch.int64)
        self.failed = torch.zeros(clips, dtype=torch.int64)
        self.faded = torch.zeros(clips, dtype=torch.float64)
        # The last evaluations, newest last; a clip that was not evaluated did not fail.
        self._recent = torch.zeros(0, clips, dtype=torch.bool)

    def record(self, succeeded: Tensor, evaluated: Tensor | None = None) -> None:
        """Notes an evaluation.

        Args:
            succeeded: `(C,)` bool.
            evaluated: `(C,)` bool, which clips it holds for; all by default.
        """
        clips = len(self.member)
        succeeded = succeeded.bool().cpu()
        known = torch.ones(clips, dtype=torch.bool) if evaluated is None else evaluated.bool().cpu()
        if succeeded.shape != (clips,) or known.shape != (clips,):
            raise PoiseError(
                f"an evaluation of {clips} clips has the shape {tuple(succeeded.shape)}",
                code="wrong-shape",
            )
        failed = known & ~succeeded
        self.tried += known
        self.failed += failed
        self.faded = torch.where(known, self.config.fade * self.faded + failed, self.faded)
        self._recent = torch.cat((self._recent, failed.unsqueeze(0)))[-self.config.memory :]

    @property
    def last_failed(self) -> Tensor:
        """`(C,)` bool, the present stage's clips that failed in the last evaluation."""
        if not len(self._recent):
            return torch.zeros_like(self.member)
        return self._recent[-1] & self.member

    @property
    def hard(self) -> Tensor:
        """`(C,)` bool, the clips that the next primitive is to learn; always of the present ones."""
        if self.config.union == "last":
            return self.last_failed
        return self._recent.any(0) & self.member

    def weights(self) -> Tensor:
        """Odds `(C,)` float64 that sum to 1, 0 for clips outside the present stage."""
        base = torch.where(self.member, self.base, 0.0)
        base = base / base.sum()
        rule, odds = self.config.rule, torch.zeros_like(base)
        if rule == "soft":
            odds = torch.where(self.member, self.failed.double(), 0.0)
        elif rule == "hard":
            odds = torch.where(self.last_failed, self.base, 0.0)
        elif rule == "floor":
            odds = torch.where(self.member, self.faded, 0.0)
        if not float(odds.sum()) > 0:
            return base
        odds = odds / odds.sum()
        return self.config.floor * base + (1 - self.config.floor) * odds if rule == "floor" else odds

    def next_stage(self, member: Tensor | None = None) -> int:
        """Goes on with the `hard` clips alone, or with `member (C,)` bool, such as all of them for the
        composer; how many there are. Failures of the new stage are counted from 0.

        No clip left is no fault: nothing changes, and the answer is 0.
        """
        member = self.hard if member is None else member.bool().cpu()
        if member.shape != self.member.shape:
            raise PoiseError(
                f"a stage of {len(self.member)} clips has the shape {tuple(member.shape)}",
                code="wrong-shape",
            )
        left = int(member.sum())
        if left:
            self.member = member.clone()
            self.failed.zero_()
            self.faded.zero_()
            self.tried.zero_()
            self._recent = self._recent[:0]
        return left

    def state(self) -> State:
        """Copies of all counts."""
        names = ("member", "tried", "failed", "faded")
        return {name: getattr(self, name).clone() for name in names} | {"recent": self._recent.clone()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from what `state` returned, of as many clips."""
        saved = take(state, "member")
        if saved.shape != self.member.shape:
            raise PoiseError(
                f"the saved state is of {len(saved)} clips, the library has {len(self.member)}",
                hint="Resume with the library it was saved with",
                code="state-differs",
            )
        for name in ("member", "tried", "failed", "faded"):
            setattr(self, name, take(state, name).clone())
        self._recent = take(state, "recent").clone()


#: "go on" training this stage, go to the "next" one, or "solved": no clip fails, training ends.
Decision = Literal["go on", "next", "solved"]


@dataclass(frozen=True)
class ConvergenceConfig:
    """When to stop a stage, in evaluations of its clips."""

    patience: Count = 3
    """Evaluations in a row without a gain after which the stage ends."""
    gain: float = 0.0
    """An improvement is a success rate above the best so far by more than this."""
    least: Count = 1
    """Evaluations that a stage gets in any case, unless it is solved."""
    most: Count | None = None
    """Evaluations after which it ends in any case."""

    def __post_init__(self) -> None:
        validate(self)
        if self.most is not None and self.most < self.least:
            what = f"most must be at least least, {self.least}, got {self.most}"
            raise PoiseError(what, "ConvergenceConfig", code="out-of-range")


class Convergence:
    """Counts evaluations of one stage; `best` is the highest success rate, at evaluation `best_at`."""

    def __init__(self, config: ConvergenceConfig | None = None):
        self.config = config or ConvergenceConfig()
        self.reset()

    def reset(self) -> None:
        """Begins another stage."""
        self.best, self.best_at, self.evaluations = -1.0, 0, 0

    def add(self, succeeded: int, total: int, improved: bool = False) -> Decision:
        """Notes an evaluation of the stage's hard set, of `total` clips, and decides.

        An empty hard set is solved: there is nothing left to learn. improved: something else was
        gained, such as help that was taken away, so that the stage's patience begins anew.
        """
        if not 0 <= succeeded <= total:
            raise PoiseError(f"{succeeded} of {total} clips cannot have succeeded", code="out-of-range")
        self.evaluations += 1
        rate = succeeded / total if total else 1.0
        if rate > self.best + self.config.gain or self.evaluations == 1:
            self.best, self.best_at = rate, self.evaluations
        if improved:
            self.best_at = self.evaluations
        if succeeded == total:
            return "solved"
        c = self.config
        stale = self.evaluations - self.best_at >= c.patience and self.evaluations >= c.least
        return "next" if stale or self.evaluations == c.most else "go on"

    def state(self) -> State:
        """The counts."""
        return {"convergence": torch.tensor([self.best, self.best_at, self.evaluations]).double()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from what `state` returned."""
        best, best_at, evaluations = take(state, "convergence").tolist()
        self.best, self.best_at, self.evaluations = best, int(best_at), int(evaluations)
