"""Evaluation: padded rollouts in, a score card with stable keys out."""

from poise.eval.rolloutset import RolloutSet
from poise.eval.scorecard import Help, ScoreCard, read_score, score_rollouts, write_score
from poise.eval.verdicts import THRESHOLDS, Row, Threshold, table

__all__ = [
    "THRESHOLDS",
    "Help",
    "RolloutSet",
    "Row",
    "ScoreCard",
    "Threshold",
    "read_score",
    "score_rollouts",
    "table",
    "write_score",
]
