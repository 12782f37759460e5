"""The engine on a GPU against its limit: mujoco_warp's own captured step in the same process."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.learn import Trainer, VecEnv
from poise.recipes.imitation import Imitation
from poise.sim import WarpBackend
from poise.sim.warp_setup import load_warp
from speed.engine import exploring
from speed.machine import median

Progress = Callable[[str], None]
_COPIED = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied")


class RawWarp:
    """`mujoco_warp.step` alone, captured as its manual recommends, on copies of a backend's worlds."""

    def __init__(self, backend: WarpBackend, substeps: int):
        self._wp, self._mjw = load_warp()
        self._device, self._substeps, room = str(backend.device), substeps, backend.capacity
        with self._wp.ScopedDevice(self._device):
            self._m = self._mjw.put_model(backend.model)
            self._m.opt.warn_overflow = 0
            self._d = self._mjw.make_data(
                backend.model, backend.num_envs, room.contacts, njmax=room.rows, nccdmax=room.convex
            )
            self._steps()  # Compiles.
            with self._wp.ScopedCapture(self._device) as capture:
                self._steps()
        self._graph = capture.graph

    def _steps(self) -> None:
        for _ in range(self._substeps):
            self._mjw.step(self._m, self._d)

    def load(self, backend: WarpBackend) -> None:
        """Takes over a backend's worlds as they are now, with what drives them."""
        for name in _COPIED:
            own = self._wp.to_torch(getattr(self._d, name))
            own.copy_(backend.raw(name))
        synchronize(backend.device)

    def seconds(self, count: int) -> float:
        """Time of `count` control steps on end."""
        start = time.perf_counter()
        with self._wp.ScopedDevice(self._device):
            for _ in range(count):
                self._wp.capture_launch(self._graph)
            self._wp.synchronize_device(self._device)
        return time.perf_counter() - start


def synchronize(device: torch.device) -> None:
    """Waits until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def bench_gpu(
    imitation: Imitation,
    num_envs: int,
    device: str = "cuda",
    repeats: int = 5,
    steps: int = 16,
    tell: Progress | None = None,
    until: float = math.inf,
) -> dict[str, Any]:
    """Stepping and training on a GPU against `mujoco_warp.step` alone, interleaved in one process.

    Every repeat measures, one right after the other: `steps` control steps of the environment with
    observations, rewards and resets; as many raw control steps from where the environment began; one
    training iteration. Ratios are taken within a repeat, and medians over them. After `until`
    (`time.monotonic()`) no further repeat begins.
    """
    sim = imitation.config.sim

    def make() -> tuple[ImitationEnv, WarpBackend]:
        backend = WarpBackend(imitation.model, num_envs, device)
        return imitation.env(seed=0, guard=False, backend=backend), backend

    env, backend = make()
    learner, _ = make()
    ppo, seed = imitation.ppo(), imitation.config.seed
    trainer = Trainer(cast(VecEnv, learner), ppo, seed, imitation.humanoid.identity)
    raw, rows = RawWarp(backend, sim.substeps), []
    env.reset()
    _walk(env, exploring(imitation, env, 2))
    trainer.iterate()
    for k in range(repeats):
        if rows and time.monotonic() > until:
            break
        if tell is not None:
            tell(f"gpu, {k + 1} of {repeats}")
        raw.load(backend)
        stepping = _walk(env, exploring(imitation, env, steps, seed=k))
        limit = raw.seconds(steps)
        stats = trainer.iterate()
        share = num_envs * steps
        training = stats.batch / (stats.collect_seconds + stats.update_seconds)
        rows.append(
            {
                "raw_per_s": share / limit,
                "stepping_per_s": share / stepping,
                "training_per_s": training,
                "stepping_of_raw": limit / stepping,
                "training_of_raw": training * limit / share,
            }
        )
    result = {name: median([row[name] for row in rows]) for name in rows[0]}
    env.close()
    learner.close()
    return {
        "device": _name(backend.device),
        "envs": num_envs,
        "repeats": len(rows),
        "rate_hz": sim.rate_hz,
        "control_hz": sim.control_hz,
        "integrator": sim.integrator,
        "contacts_per_world": backend.capacity.contacts,
        "constraints_per_world": backend.capacity.rows,
        **result,
    }


def _walk(env: ImitationEnv, actions: list[Tensor]) -> float:
    """Seconds of these control steps."""
    actions = [action.to(env.device) for action in actions]
    synchronize(env.device)
    start = time.perf_counter()
    for action in actions:
        env.step(action)
    synchronize(env.device)
    return time.perf_counter() - start


def _name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "Warp's CPU device"
