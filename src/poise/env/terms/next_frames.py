"""Observations of Skeleton2Humanoid's policy (section 3.4.1): the state, and what the next reference
frames differ from it by.

    f_t = (q_t, v_t, j_t, g_t; q~_k - q_t, j~_k - j_t, g~_k - g_t, v~_k - v_t for each next frame k)

q are joint angles, v velocities, j joint positions seen from the head, g joint positions in the world.
Here everything in the world is seen from the root's heading, so that a policy works anywhere; the
root's turn is 6D in place of Euler angles, and velocities are exact in place of finite differences.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poise.env.frame import Frame, Pose
from poise.spatial import into_heading, quat_between, quat_conj, quat_rotate, quat_to_sixd


def joints_from_head(frame: Frame, head: int) -> Tensor:
    """j: body origins in the head's own frame, m `(N, 3 B)`. head: its row."""
    return _from_head(frame.sim, head).flatten(1)


def next_angles(frame: Frame, step: int) -> Tensor:
    """q~ - q: the root's turn to a later reference frame, 6D, and the hinge angles that are missing, rad
    `(N, 6 + n)`. step: index into `TaskConfig.window`."""
    sim, later = frame.sim, frame.window
    turn = quat_between(sim.qpos[:, 3:7], later.qpos[:, step, 3:7])
    return torch.cat((quat_to_sixd(turn), later.qpos[:, step, 7:] - sim.qpos[:, 7:]), -1)


def next_velocities(frame: Frame, step: int) -> Tensor:
    """v~ - v: of the root in the heading frame, m/s, and in its own, rad/s, and of the hinges, rad/s
    `(N, 6 + n)`."""
    sim, later = frame.sim, frame.window
    missing = later.qvel[:, step] - sim.qvel
    linear = into_heading(sim.heading, missing[:, None, :3]).squeeze(1)
    return torch.cat((linear, missing[:, 3:]), -1)


def next_joints(frame: Frame, step: int, head: int) -> Tensor:
    """j~ - j and g~ - g, m `(N, 6 B)`: seen from each one's own head, and in the heading frame."""
    sim, later = frame.sim, frame.window
    own = _from_head(sim, head)
    pos = later.pos[:, step]
    turned = quat_conj(later.quat[:, step, head]).unsqueeze(1)
    seen = quat_rotate(turned, pos - pos[:, head : head + 1])
    world = into_heading(sim.heading, pos - sim.pos)
    return torch.cat((seen - own, world), 1).flatten(1)


def _from_head(pose: Pose, head: int) -> Tensor:
    away = pose.pos - pose.pos[:, head : head + 1]
    return quat_rotate(quat_conj(pose.quat[:, head]).unsqueeze(1), away)
