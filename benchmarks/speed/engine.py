"""The engine against its limit: MuJoCo's own batch on the very states that the environment stepped."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import mujoco
import torch
from mujoco.batch import Batch
from torch import Tensor

from poise.env import ImitationEnv
from poise.recipes.imitation import Imitation
from poise.sim.backend import STANDARD_FIELDS
from speed.machine import Clock, cores, median, memory_mb

_VEL, _NONE = int(mujoco.mjtStage.mjSTAGE_VEL), int(mujoco.mjtStage.mjSTAGE_NONE)
Progress = Callable[[str], None]


class Raw:
    """`mujoco.batch` alone, with the same fields copied out, replaying recorded states and drives."""

    def __init__(self, env: ImitationEnv, threads: int):
        self.batch = Batch(env.backend.model, env.num_envs, threads)
        self.substeps = env.substeps
        for name in STANDARD_FIELDS:
            self.batch.bind(name)

    def seconds(self, states: list[Tensor], stage: int = _VEL) -> float:
        """Time of one control step from each of the recorded states; only the stepping counts."""
        spent = 0.0
        for state in states:
            self.batch.state[:] = state.numpy()
            start = time.perf_counter()
            self.batch.step(None, self.substeps, stage)
            spent += time.perf_counter() - start
        return spent


def exploring(imitation: Imitation, env: ImitationEnv, count: int, seed: int = 0) -> list[Tensor]:
    """Actions as an untrained policy explores them: noise alone."""
    rng = torch.Generator().manual_seed(seed)
    std = torch.tensor(imitation.ppo().std)
    return [std * torch.randn(env.num_envs, env.num_actions, generator=rng) for _ in range(count)]


def record(env: ImitationEnv, actions: list[Tensor]) -> list[Tensor]:
    """The simulator's whole state before the physics of every step, drive included."""
    states: list[Tensor] = []
    plain = env.backend.step

    def keeping(nstep: int = 1) -> None:
        states.append(env.backend.snapshot(derived=False))
        plain(nstep)

    env.backend.step = keeping  # type: ignore[method-assign]
    try:
        for action in actions:
            env.step(action)
    finally:
        del env.backend.step
    return states


def bench_engine(
    imitation: Imitation,
    threads: int = 0,
    repeats: int = 5,
    steps: int = 16,
    tell: Progress | None = None,
    until: float = math.inf,
) -> dict[str, Any]:
    """Stepping and training against the raw limit, interleaved in one process.

    Every repeat measures, one right after the other: `steps` control steps of the environment with
    observations, rewards and resets; MuJoCo's batch alone on the same number of states, recorded from
    that environment; one training iteration. Ratios are taken within a repeat, and medians over them.
    After `until` (`time.monotonic()`) no further repeat begins.
    """
    threads = threads or cores()
    before = memory_mb()
    env, trainer = imitation.env(threads=threads), imitation.trainer(threads=threads)
    raw, clock, rows = Raw(env, threads), Clock(), []
    env.reset()
    for _ in range(2):
        for action in exploring(imitation, env, steps):
            env.step(action)
        trainer.iterate()
    with ExitStack() as stack:
        learner: Any = trainer.env
        for owner, method, name in (
            (env.backend, "step", "stepping physics"),
            (learner.backend, "step", "physics"),
            (learner, "step", "step"),
        ):
            stack.enter_context(clock.on(owner, method, name))
        for k in range(repeats):
            if rows and time.monotonic() > until:
                break
            if tell is not None:
                tell(f"engine, {k + 1} of {repeats}")
            actions = exploring(imitation, env, steps, seed=k)
            clock.read()
            start = time.perf_counter()
            for action in actions:
                env.step(action)
            stepping = time.perf_counter() - start
            own = clock.read()["stepping physics"]
            states = _recorded(env, actions)
            limit, bare = raw.seconds(states), raw.seconds(states, _NONE)
            stats = trainer.iterate()
            parts = clock.read()
            share = env.num_envs * steps
            training = stats.collect_seconds + stats.update_seconds
            row = {
                "raw": share / limit,
                "raw_without_derived": share / bare,
                "stepping": share / stepping,
                "training": stats.batch / training,
                "stepping_of_raw": limit / stepping,
                "stepping_physics_share": own / stepping,
                "training_of_raw": (stats.batch / training) / (share / limit),
                "physics": parts["physics"] / training,
                "terms": (parts["step"] - parts["physics"]) / training,
                "policy": (stats.collect_seconds - parts["step"]) / training,
                "update": stats.update_seconds / training,
            }
            rows.append(row)
    result = {name: median([r[name] for r in rows]) for name in rows[0]}
    for name in ("raw", "raw_without_derived", "stepping", "training"):
        result[f"{name}_per_s"] = round(result.pop(name))
    phases = {name: result.pop(name) for name in ("physics", "terms", "policy", "update")}
    sim = imitation.config.sim
    out = {
        "envs": env.num_envs,
        "threads": threads,
        "repeats": len(rows),
        "rate_hz": sim.rate_hz,
        "control_hz": sim.control_hz,
        "integrator": sim.integrator,
        "observations": env.num_obs,
        "actions": env.num_actions,
        **result,
        "training_phases": phases,
        "memory_mb": round(memory_mb() - before),
    }
    env.close()
    trainer.env.close()
    return out


def _recorded(env: ImitationEnv, actions: list[Tensor]) -> list[Tensor]:
    """`record` past a clock that may sit on the backend's step."""
    timed = env.backend.__dict__.pop("step", None)
    try:
        return record(env, actions)
    finally:
        if timed is not None:
            env.backend.step = timed  # type: ignore[method-assign]
