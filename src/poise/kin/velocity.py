"""Generalized velocities of a motion by finite differences."""

from __future__ import annotations

import numpy as np
import torch

from poise.spatial import quat_between, quat_to_rotvec


def qpos_velocity(qpos: np.ndarray, fps: float) -> np.ndarray:
    """`(T, nv)` velocity of `qpos (T, 7 + n)` in MuJoCo's convention.

    Root linear velocity in the world frame (m/s), root angular velocity in the root's own frame
    (rad/s), hinge speeds (rad/s). Central differences; one-sided at both ends.
    """
    q = torch.tensor(qpos, dtype=torch.float64)
    frames = len(q)
    ahead = torch.arange(frames).add(1).clamp(max=frames - 1)
    behind = torch.arange(frames).sub(1).clamp(min=0)
    dt = (ahead - behind).to(q.dtype).unsqueeze(-1) / fps
    linear = (q[ahead, :3] - q[behind, :3]) / dt
    # w_b = log(q_behind^-1 q_ahead) / dt, in the root's frame
    turn = quat_to_rotvec(quat_between(q[behind, 3:7], q[ahead, 3:7])) / dt
    hinges = (q[ahead, 7:] - q[behind, 7:]) / dt
    return torch.cat((linear, turn, hinges), -1).numpy()
