"""Starts that differ by a stated spread, and the null that does nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.motion.rotations import quat_mul, rotvec_to_quat
from poise.score import Nothing

__all__ = ["SPREAD", "Nothing", "Spread", "scattered"]


@dataclass(frozen=True)
class Spread:
    """Normal deviations of a start from the reference: hinges and root's turn (rad), place on the floor
    (m), velocity of the root (m/s) and of all turns (rad/s)."""

    joints_rad: float = 0.05
    place_m: float = 0.03
    velocity_m_s: float = 0.1
    turning_rad_s: float = 0.2

    def __str__(self) -> str:
        return (
            f"starts off by {self.joints_rad:g} rad, {self.place_m:g} m, {self.velocity_m_s:g} m/s, "
            f"{self.turning_rad_s:g} rad/s"
        )


#: What rows "from spread starts" are drawn from.
SPREAD = Spread()


def scattered(env: ImitationEnv, trial: Tensor, spread: Spread = SPREAD) -> Tensor:
    """Moves characters off their starts; observations `(N, O)`.

    trial: `(N,)`, which draw each is; 0 stays where it is.
    """
    state = env.backend.state
    qpos, qvel = state.qpos.clone(), state.qvel.clone()
    hinges = qpos.shape[1] - 7
    for i, seed in enumerate(trial.tolist()):
        if not seed:
            continue
        rng = np.random.default_rng([i, seed])
        turn = torch.as_tensor(rng.normal(scale=spread.joints_rad, size=3 + hinges)).to(qpos)
        qpos[i, 3:7] = quat_mul(qpos[i, 3:7], rotvec_to_quat(turn[:3]))
        qpos[i, 7:] += turn[3:]
        qpos[i, :2] += torch.as_tensor(rng.normal(scale=spread.place_m, size=2)).to(qpos)
        qvel[i, :3] += torch.as_tensor(rng.normal(scale=spread.velocity_m_s, size=3)).to(qvel)
        qvel[i, 3:] += torch.as_tensor(rng.normal(scale=spread.turning_rad_s, size=3 + hinges)).to(qvel)
    env.backend.write(None, qpos, qvel)
    return env.observe()
