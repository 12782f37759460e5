"""Evaluation: padded rollouts in, a score card with stable keys out."""

from poise.eval.episodes import Recording, run_episodes, shapes_of, start_frames
from poise.eval.recovery import RecoveryCard, recovery_card, trial_task, write_recovery
from poise.eval.rolloutset import RolloutSet
from poise.eval.scorecard import Help, ScoreCard, read_score, score_rollouts, write_score
from poise.eval.verdicts import THRESHOLDS, Row, Threshold, table

__all__ = [
    "THRESHOLDS",
    "Help",
    "Recording",
    "RecoveryCard",
    "RolloutSet",
    "Row",
    "ScoreCard",
    "Threshold",
    "read_score",
    "recovery_card",
    "run_episodes",
    "score_rollouts",
    "shapes_of",
    "start_frames",
    "table",
    "trial_task",
    "write_recovery",
    "write_score",
]
