"""Evaluation: padded rollouts in, a score card with stable keys out."""

from poise.eval.episodes import Recording, run_episodes, shapes_of, start_frames
from poise.eval.rolloutset import RolloutSet
from poise.eval.scorecard import Help, ScoreCard, read_score, score_rollouts, write_score
from poise.eval.verdicts import THRESHOLDS, Row, Threshold, table

__all__ = [
    "THRESHOLDS",
    "Help",
    "Recording",
    "RolloutSet",
    "Row",
    "ScoreCard",
    "Threshold",
    "read_score",
    "run_episodes",
    "score_rollouts",
    "shapes_of",
    "start_frames",
    "table",
    "write_score",
]
