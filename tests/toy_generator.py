"""Generators of motion that are told at once, and a task for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.recipes.imitation import Imitation


class Stands:
    """Goes on with the last frame of its past."""

    past, future = 5, 10

    def __init__(self, pose: Tensor):
        self.pose = pose

    def begin(self, count: int, rng: torch.Generator) -> Tensor:
        return self.pose.expand(count, self.past, -1).clone()

    def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        return past[:, -1:].repeat(1, self.future, 1)

    def rows(self) -> Mapping[str, Tensor]:
        return {}


def endless_task(tracker: Tracker) -> Imitation:
    """A policy's body with a task whose goal is to be set."""
    made = imitation_of(tracker, [place(tracker.example, tracker)])
    return replace(made, task=replace(made.task, help_by="all"))
