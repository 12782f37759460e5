"""Observations. All are free of world x, y and of heading, so that a policy works anywhere."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.env.frame import Frame, Pose
from poise.spatial import into_heading, quat_between, quat_to_sixd


def root_height(frame: Frame) -> Tensor:
    """Root height above the floor, m `(N, 1)`."""
    return frame.sim.qpos[:, 2:3]


def root_tilt(frame: Frame) -> Tensor:
    """Root orientation without heading, first two matrix columns `(N, 6)`."""
    columns = quat_to_sixd(_root(frame.sim)).unflatten(-1, (2, 3))
    return into_heading(frame.sim.heading, columns).flatten(1)


def root_velocity(frame: Frame) -> Tensor:
    """Root linear velocity in the heading frame (m/s) and angular in the root frame (rad/s) `(N, 6)`."""
    linear = into_heading(frame.sim.heading, frame.sim.qvel[:, None, :3])
    return torch.cat((linear.squeeze(1), frame.sim.qvel[:, 3:6]), -1)


def joint_angles(frame: Frame) -> Tensor:
    """Hinge angles, rad `(N, n)`."""
    return frame.sim.qpos[:, 7:]


def joint_velocities(frame: Frame) -> Tensor:
    """Hinge speeds, rad/s `(N, n)`."""
    return frame.sim.qvel[:, 6:]


def phase(frame: Frame) -> Tensor:
    """Place in the clip from 0 to 1 `(N, 1)`."""
    return frame.phase.unsqueeze(-1)


def body_positions(frame: Frame) -> Tensor:
    """Body origins relative to the root in the heading frame, m `(N, 3 (B - 1))`."""
    sim = frame.sim
    return into_heading(sim.heading, sim.pos[:, 1:] - sim.pos[:, :1]).flatten(1)


def target_joints(frame: Frame) -> Tensor:
    """Next reference hinge angles minus the present ones, rad, and their speeds `(N, 2 n)`."""
    ahead = _ahead(frame)
    return torch.cat((ahead.qpos[:, 7:] - frame.sim.qpos[:, 7:], ahead.qvel[:, 6:]), -1)


def target_root(frame: Frame) -> Tensor:
    """Next reference root against the present one, in the present heading frame `(N, 12)`.

    Position difference m, orientation difference 6D, reference velocity m/s.
    """
    ahead, sim = _ahead(frame), frame.sim
    vectors = torch.stack((ahead.pos[:, 0] - sim.pos[:, 0], ahead.qvel[:, :3]), 1)
    offset, velocity = into_heading(sim.heading, vectors).unbind(1)
    turn = quat_between(_root(sim), _root(ahead))
    return torch.cat((offset, quat_to_sixd(turn), velocity), -1)


def target_bodies(frame: Frame) -> Tensor:
    """Next reference body origins minus the present ones, in the present heading frame, m."""
    return into_heading(frame.sim.heading, _ahead(frame).pos - frame.sim.pos).flatten(1)


def _root(pose: Pose) -> Tensor:
    return pose.qpos[:, 3:7]


def _ahead(frame: Frame) -> Pose:
    if frame.ahead is None:
        raise ValueError("observations of the reference need the next reference frame")
    return frame.ahead
