"""Evaluation: padded rollouts in, a score card with stable keys out."""

from poise.eval.card import THRESHOLDS, Help, Row, ScoreCard, Threshold, read_score, table, write_score
from poise.eval.clip_results import ClipJudge, ClipResults
from poise.eval.episodes import (
    Nothing,
    Observer,
    Recorder,
    Recording,
    perturb,
    run_episodes,
    run_in_batches,
    simulate,
    start_frames,
)
from poise.eval.recovery import RecoveryCard, recovery_card, trial_task
from poise.eval.rolloutset import RolloutSet
from poise.eval.scorecard import TRACKING, clip_figures, score_rollouts
from poise.eval.transitions import Transitions, record_transitions

__all__ = [
    "THRESHOLDS",
    "TRACKING",
    "ClipJudge",
    "ClipResults",
    "Help",
    "Nothing",
    "Observer",
    "Recorder",
    "Recording",
    "RecoveryCard",
    "RolloutSet",
    "Row",
    "ScoreCard",
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
