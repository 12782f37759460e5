"""Episodes of a policy in, a score card with stable keys and a report out.

Cards and thresholds need no simulation; the rest is imported when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from poise.lazy import lazy
from poise.score.card import CardRow, Help, ScoreCard, read_score, table, write_score
from poise.score.thresholds import THRESHOLDS, Threshold

if TYPE_CHECKING:
    from poise.score.episodes import (
        Nothing,
        Observer,
        Recorder,
        Recording,
        Spread,
        Transitions,
        perturb,
        record_transitions,
        run_episodes,
        run_in_batches,
        simulate,
        start_frames,
    )
    from poise.score.recovered import RecoveryCard, recovery_card, trial_task
    from poise.score.rollouts import ClipJudge, ClipResults, RolloutSet
    from poise.score.scorecard import TRACKING, clip_figures, score_rollouts

__all__ = [
    "THRESHOLDS",
    "TRACKING",
    "CardRow",
    "ClipJudge",
    "ClipResults",
    "Help",
    "Nothing",
    "Observer",
    "Recorder",
    "Recording",
    "RecoveryCard",
    "RolloutSet",
    "ScoreCard",
    "Spread",
    "Threshold",
    "Transitions",
    "clip_figures",
    "perturb",
    "read_score",
    "record_transitions",
    "recovery_card",
    "run_episodes",
    "run_in_batches",
    "score_rollouts",
    "simulate",
    "start_frames",
    "table",
    "trial_task",
    "write_score",
]

__getattr__ = lazy(
    __name__,
    {
        "episodes": "Nothing Observer perturb record_transitions Recorder Recording "
        "run_episodes run_in_batches simulate Spread start_frames Transitions",
        "recovered": "recovery_card RecoveryCard trial_task",
        "rollouts": "ClipJudge ClipResults RolloutSet",
        "scorecard": "clip_figures score_rollouts TRACKING",
    },
)
