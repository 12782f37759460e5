"""Points that also tell how they move, and clips of points that all go to the right."""

from __future__ import annotations

import torch
from torch import Tensor
from toy_point_env import PointEnv

from poise.learn import StepResult

FRAMES = 4


class StyleEnv(PointEnv):
    """A `FeatureSource`: the features of a point are its place and its last velocity."""

    num_features = 4

    def __init__(self, num_envs: int = 64, seed: int = 0, past: bool = False):
        super().__init__(num_envs, seed)
        self.has_past = past
        self.moved = torch.zeros(num_envs, 4)
        self.asked: list[Tensor] = []

    def step(self, actions: Tensor) -> StepResult:
        before = self.p.clone()
        step = super().step(actions)
        reached = step.final_obs[:, :2]
        self.moved = torch.cat([reached, reached - before], -1)
        return step

    def features(self) -> Tensor:
        return self.moved

    def past(self, rows: Tensor, count: int) -> Tensor | None:
        self.asked.append(rows)
        if not self.has_past:
            return None
        start = torch.cat([self.p[rows], torch.zeros(len(rows), 2)], -1)
        return start.unsqueeze(1).expand(len(rows), count, 4)


def to_the_right(count: int, generator: torch.Generator) -> Tensor:
    """Windows of points that move by 0.1 along x."""
    start = 2 * torch.rand(count, 1, 2, generator=generator) - 1
    way = torch.tensor([0.1, 0.0])
    place = start + way * torch.arange(FRAMES).view(1, -1, 1)
    return torch.cat([place, way.expand(count, FRAMES, 2)], -1).flatten(1)
