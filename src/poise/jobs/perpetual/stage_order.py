"""The stages of a training: which follows which, when each ends at the latest (PHC, Alg. 1), and what an
iteration of one came to.

    primitive 1 on all clips -> primitive k on what still fails -> recovery -> composer on all clips

| `Perpetual`            | stages                                                                      |
|------------------------|-----------------------------------------------------------------------------|
| as it is               | primitive 1 .. K, recovery, composer with recovery interleaved              |
| no recovery            | primitive 1 .. K, composer; primitive 1 alone where nothing fails any more  |
| the first can recover  | the same, the composer with recovery interleaved                            |
| no progressive         | joint (K primitives and composer together), joint with recovery             |
| no multiplicative      | single (of a primitive's size), single with recovery                        |
| single                 | single, single with recovery                                                |

A network with recovery is the same one as before, which goes on learning.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from poise.learn import Decision, IterationStats
from poise.recipes.perpetual_settings import Perpetual, Recovers
from poise.score import ClipResults, RecoveryCard

#: Networks that learn all clips in one stage.
WHOLE = ("single", "joint")


def first_stage(config: Perpetual) -> Stage:
    """What a run begins with."""
    if config.single or not config.multiplicative:
        return Stage("single")
    return Stage("primitive" if config.progressive else "joint")


def own_recovery(config: Perpetual) -> bool:
    """Whether recovery is learned by a primitive of its own, or by one network after tracking."""
    return config.recovery and config.recovering.primitive == "own"


def first_recovers(config: Perpetual) -> bool:
    """Whether the first primitive is a policy that goes on and can recover already."""
    return config.recovery and config.recovering.primitive == "first"


def lasts(config: Perpetual, stage: Stage) -> bool:
    """Whether no stage follows, so that this one has all the time that is left."""
    if stage.kind == "composer" or stage.mixed:
        return True
    if stage.kind in WHOLE:
        return not config.recovery
    return stage.kind == "primitive" and config.max_primitives == 1 and not own_recovery(config)


def following(config: Perpetual, stage: Stage, fails: bool) -> Stage | None:
    """What comes after a stage; None ends the training.

    fails: whether a clip failed that one primitive more could learn.
    """
    number = stage.number + 1
    if lasts(config, stage):
        return None
    if stage.kind in WHOLE:
        return Stage(stage.kind, number, mixed=True)
    if stage.kind == "primitive":
        if fails and stage.number < config.max_primitives:
            return Stage("primitive", number)
        if own_recovery(config):
            return Stage("recovery", number)
        if not fails and stage.number == 1:
            return None
    return Stage("composer", number, mixed=config.recovery)


def ends(config: Perpetual, stage: Stage, begun: float) -> float:
    """The share of the whole training at which a stage ends at the latest.

    begun: the share at which it began. Time that the primitives leave over is shared by recovery and
    composer as the rest would be.
    """
    if lasts(config, stage):
        return 1.0
    share = config.recovering.share if own_recovery(config) else 0.0
    first, last = ((1.0 - share) * x for x in config.shares)
    if stage.kind == "recovery":
        return begun + (1.0 - begun) * share / (1.0 - last)
    if stage.kind in WHOLE or config.max_primitives == 1:
        return last
    return first + (last - first) * (stage.number - 1) / (config.max_primitives - 1)


def primitives(config: Perpetual, stage: Stage) -> int:
    """Primitives of tracking that were begun by this stage; 0 for a network that learns all at once."""
    if stage.kind == "primitive":
        return stage.number
    if stage.kind == "recovery":
        return stage.number - 1
    # Before a composer comes the primitive of recovery, if there is one.
    return stage.number - 1 - own_recovery(config) if stage.kind == "composer" else 0


def is_over(config: Perpetual, stage: Stage, decision: Decision, share: float) -> bool:
    """Whether a stage ends of which an evaluation, made at this share of the whole training, says
    `decision`."""
    solved = decision == "solved"
    if lasts(config, stage) or (solved and following(config, stage, fails=False) is None):
        # The last stage has all the time there is.
        return solved
    # Without any time left nothing begins.
    return decision != "go on" and share < 1.0


def most_help(config: Perpetual, stage: Stage, begun: float, share: float) -> float:
    """The share of the help's limits that a stage which began at `begun` may still have at `share` of
    the whole training, so that its help ends in any case."""
    span = max(1e-9, ends(config, stage, begun) - begun) * config.help_share
    return min(1.0, max(0.0, 1.0 - (share - begun) / span))


Kind = Literal["primitive", "single", "joint", "recovery", "composer"]


@dataclass(frozen=True)
class Stage:
    """One training after another, see `following`.

    Attributes:
        number: counts all stages of a run from 1.
        mixed: episodes of recovery are interleaved.
    """

    kind: Kind
    number: int = 1
    mixed: bool = False

    @property
    def name(self) -> str:
        """As it is shown and noted: "primitive 2"."""
        if self.kind == "primitive":
            return f"primitive {self.number}"
        return f"{self.kind} with recovery" if self.mixed and self.kind != "composer" else self.kind

    @property
    def recovers(self) -> Recovers | None:
        """As what the stage learns recovery; None: it tracks alone."""
        if self.kind == "recovery":
            return "primitive"
        return "composer" if self.mixed else None


@dataclass(frozen=True)
class Progress:
    """What one iteration came to.

    Attributes:
        stage: the one that was trained.
        iteration: over all stages.
        share: of the whole training, 0 to 1.
        clips: of the stage; of the recovery primitive, its trials.
        succeeded: how many of the `clips` succeeded in the last evaluation; None before the first.
        help_n: N, the help that is left on the clip that has most.
        results, recovery: evaluations that were made after this iteration.
        following: the stage that begins now.
        trouble: why training diverged before this iteration, which then was made again from the last
            checkpoint; empty without a divergence.
    """

    stage: Stage
    iteration: int
    stats: IterationStats
    share: float
    succeeded: int | None
    clips: int
    help_n: float
    results: ClipResults | None
    recovery: RecoveryCard | None
    following: Stage | None
    trouble: str = ""
