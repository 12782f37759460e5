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
from poise.eval.field_card import FieldTable, markdown, read_field_table, write_field_table
from poise.eval.field_paper import PHC_RECOVERY, PHC_ROWS, paper_rows
from poise.eval.field_table import field_table
from poise.eval.recovery import RecoveryCard, recovery_card, trial_task, write_recovery
from poise.eval.rolloutset import RolloutSet
from poise.eval.scorecard import Help, ScoreCard, read_score, score_rollouts, write_score
from poise.eval.verdicts import THRESHOLDS, Row, Threshold, table

__all__ = [
    "PHC_RECOVERY",
    "PHC_ROWS",
    "THRESHOLDS",
    "ClipJudge",
    "ClipResults",
    "FieldTable",
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
    "field_table",
    "markdown",
    "paper_rows",
    "read_field_table",
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
    "write_field_table",
    "write_recovery",
    "write_score",
]
