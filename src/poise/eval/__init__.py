"""Evaluation: padded rollouts in, a score card with stable keys out."""

from poise.eval.clip_figures import clip_figures
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
    "clip_figures",
    "read_score",
    "run_episodes",
    "score_rollouts",
    "shapes_of",
    "start_frames",
    "table",
    "write_score",
]
