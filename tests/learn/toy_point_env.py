"""A toy environment: points in the plane are to be pushed to their targets."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.learn import StepResult

LIMIT = 20  # Control steps until the time-out.


class PointEnv:
    """Observation (position, target), action = velocity / 5, reward exp(-|p - target|^2); failure
    outside |p| < 3. It keeps to the `VecEnv` protocol."""

    num_obs, num_actions = 4, 2
    device = torch.device("cpu")

    def __init__(self, num_envs: int = 64, seed: int = 0):
        self.num_envs = num_envs
        self.rng = torch.Generator().manual_seed(seed)
        self.p = torch.zeros(num_envs, 2)
        self.target = torch.zeros(num_envs, 2)
        self.clock = torch.zeros(num_envs, dtype=torch.int64)

    def _restart(self, rows: Tensor) -> None:
        n = len(rows)
        self.p[rows] = 2 * torch.rand(n, 2, generator=self.rng) - 1
        self.target[rows] = 2 * torch.rand(n, 2, generator=self.rng) - 1
        self.clock[rows] = 0

    def _obs(self) -> Tensor:
        return torch.cat([self.p, self.target], -1)

    def reset(self) -> Tensor:
        self._restart(torch.arange(self.num_envs))
        return self._obs()

    def step(self, actions: Tensor) -> StepResult:
        self.p += 0.2 * actions
        self.clock += 1
        distance = (self.p - self.target).norm(dim=-1)
        terminated = self.p.norm(dim=-1) > 3
        truncated = self.clock >= LIMIT
        final = self._obs()
        self._restart((terminated | truncated).nonzero().squeeze(-1))
        log = {"distance": float(distance.mean())}
        return StepResult(self._obs(), (-(distance**2)).exp(), terminated, truncated, final, log)

    def state(self) -> dict[str, Tensor]:
        return {
            "p": self.p.clone(),
            "target": self.target.clone(),
            "clock": self.clock.clone(),
            "rng": self.rng.get_state(),
        }

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.p.copy_(state["p"])
        self.target.copy_(state["target"])
        self.clock.copy_(state["clock"])
        self.rng.set_state(state["rng"])

    def close(self) -> None:
        pass
