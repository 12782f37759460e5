"""What every imitation recipe shares: a built task that can be trained and watched."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from poise.body import Humanoid
from poise.env import ImitationEnv, Reference, TaskConfig
from poise.kin import FitReport
from poise.learn import PPOConfig, Trainer, VecEnv, WarmStart
from poise.motion import ClipLibrary
from poise.sim import CpuBackend, NanGuard


@dataclass(frozen=True, eq=False)
class Imitation:
    """A library with a body, ready to be learned.

    config: the recipe's settings; it must have `num_envs`, `seed`, `sim`, `ppo` and `residual_std`.
    """

    library: ClipLibrary
    humanoid: Humanoid
    reference: Reference
    report: FitReport
    config: Any
    task: TaskConfig

    def env(
        self,
        num_envs: int | None = None,
        seed: int | None = None,
        auto_reset: bool = True,
        threads: int = 0,
        dumps: Path | None = None,
    ) -> ImitationEnv:
        """An environment of this task; without `auto_reset` for evaluation from given frames."""
        backend = CpuBackend(self.humanoid.model, num_envs or self.config.num_envs, threads)
        seed = int(self.config.seed if seed is None else seed)
        guard = NanGuard(backend, dumps, seed=seed)
        task = replace(self.task, auto_reset=auto_reset)
        env = ImitationEnv(self.reference, backend, task, self.config.sim.substeps, seed, guard=guard)
        guard.where = env.where
        return env

    def ppo(self) -> PPOConfig:
        """The learner's settings, with one deviation of the action noise per action."""
        ppo, extra = self.config.ppo, self.task.residual.dims if self.task.residual else 0
        if not isinstance(ppo.std, float | int):
            return ppo
        joints = (float(ppo.std),) * len(self.humanoid.hinges)
        return replace(ppo, std=joints + (float(self.config.residual_std),) * extra)

    def trainer(
        self,
        threads: int = 0,
        dumps: Path | None = None,
        warm_start: WarmStart | None = None,
        ppo: PPOConfig | None = None,
        **metadata: Any,
    ) -> Trainer:
        """A PPO trainer on a fresh environment; `ppo` in place of this task's own settings."""
        env = self.env(threads=threads, dumps=dumps)
        cores = threads or len(os.sched_getaffinity(0))
        return Trainer(
            # An EnvStep has the fields of the learner's Step; neither room knows the other.
            cast(VecEnv, env),
            ppo or self.ppo(),
            self.config.seed,
            self.humanoid.identity,
            metadata=metadata,
            warm_start=warm_start,
            update_threads=min(cores, 4),
        )
