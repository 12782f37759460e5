"""Evaluation: padded rollouts in, a score card with stable keys out."""

from poise.eval.clip_figures import clip_figures
from poise.eval.clip_results import ClipJudge, ClipResults
from poise.eval.episodes import (
    Observer,
    Recorder,
    Recording,
    record,
    run_episodes,
    run_in_batches,
    simulate,
    start_frames,
)
from poise.eval.recovery import RecoveryCard, recovery_card, trial_task, write_recovery
from poise.eval.rolloutset import RolloutSet
from poise.eval.scorecard import Help, ScoreCard, read_score, score_rollouts, write_score
from poise.eval.verdicts import THRESHOLDS, Row, Threshold, table

__all__ = [
    "THRESHOLDS",
    "ClipJudge",
    "ClipResults",
    "Help",
    "Observer",
    "Recorder",
    "Recording",
    "RecoveryCard",
    "RolloutSet",
    "Row",
    "ScoreCard",
    "Threshold",
    "clip_figures",
    "read_score",
    "record",
    "recovery_card",
    "run_episodes",
    "run_in_batches",
    "score_rollouts",
    "simulate",
    "start_frames",
    "table",
    "trial_task",
    "write_recovery",
    "write_score",
]
