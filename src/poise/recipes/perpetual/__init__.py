"""Perpetual Humanoid Control: one policy for a library, trained stage after stage by itself."""

from poise.recipes.perpetual.config import Perpetual, RecoveryPlan
from poise.recipes.perpetual.task import RECIPE, build, stage_task, task

__all__ = ["RECIPE", "Perpetual", "RecoveryPlan", "build", "stage_task", "task"]
