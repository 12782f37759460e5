"""From the name of a device to the backend that steps on it."""

from __future__ import annotations

import mujoco
import torch

from poise.sim.backend import Backend
from poise.sim.cpu import CpuBackend
from poise.sim.warp import WarpBackend
from poise.sim.warp_setup import load_warp, resolve_device


def make_backend(
    spec_or_model: mujoco.MjSpec | mujoco.MjModel,
    num_envs: int,
    device: str | torch.device = "cpu",
    *,
    threads: int = 0,
) -> Backend:
    """`num_envs` worlds on "cpu" (MuJoCo in float64 on `threads` threads) or "cuda" (mujoco-warp)."""
    if check_device(device).type == "cpu":
        return CpuBackend(spec_or_model, num_envs, threads)
    return WarpBackend(spec_or_model, num_envs, device)


def check_device(device: str | torch.device) -> torch.device:
    """The device of that name, after checking that the physics can run there; a PoiseError otherwise."""
    found = resolve_device(device)
    if found.type == "cuda":
        load_warp()
    return found
