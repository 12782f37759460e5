"""Which of several attempts at one motion is kept: one order for all of them, whatever made them.

An attempt is done, or it is not; then it counts how much helped, how far it came, and how it was done:

1. to its end, upright and on its feet where the motion is; to its end; lost;
2. of those to their end the one with less help, of the others the one that came farther;
3. the smaller error, then the less jerk, then the less slide, each in steps within which attempts are
   alike.

What is lost is said by `metrics.has_lost` alone, as the score card does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from poise.eval import ScoreCard, score_rollouts
from poise.eval.rolloutset import RolloutSet

#: The rule by which a motion is lost: a mean distance of more than `metrics.LOST`.
RULE = "phc"
#: How an attempt ended.
LOST, SURVIVED, TRACKED = 0, 1, 2
#: Steps within which attempts are alike: mm of error, shares of the reference's jerk, mm/s of slide.
ERROR_MM, JERK, SLIDE = 10.0, 0.1, 10.0


class Merit(NamedTuple):
    """How good an attempt is, as a tuple of which the larger one is better.

    Attributes:
        ended: `TRACKED`, `SURVIVED` or `LOST`.
        unhelped: less the mean force of help, N; 0 without any, and of what is lost.
        reached: s before it was lost; inf where it was not.
        error, jerk, slide: less the steps that each is.
    """

    ended: int
    unhelped: float
    reached: float
    error: float = 0.0
    jerk: float = 0.0
    slide: float = 0.0

    @staticmethod
    def of(card: ScoreCard) -> Merit:
        """Of the score of a single episode."""
        fails = card.per_clip[0]["first_fail_s"]
        ended = LOST if card.succ < 1.0 else SURVIVED if card.survived else TRACKED
        usual = card.reference.get("jerk", math.nan)
        return Merit(
            ended,
            -card.help.force_mean_n if ended else 0.0,
            math.inf if ended else fails,
            _steps(card.mpjpe_global_mm, ERROR_MM),
            _steps(card.jerk / usual if usual else math.nan, JERK),
            _steps(card.foot_slide_mm_per_s, SLIDE),
        )


def merit(rollouts: RolloutSet, row: int = 0) -> Merit:
    """Of one of some episodes."""
    return Merit.of(score_rollouts(rollouts.episode(row), rule=RULE))


def _steps(value: float, step: float) -> float:
    """Less the whole steps of a figure; one that was not measured is the worst."""
    return -float(math.floor(value / step)) if math.isfinite(value) else -math.inf
