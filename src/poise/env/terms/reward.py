"""Imitation rewards of Residual Force Control, appendix B (DeepMimic's and EgoPose's forms).

Every function returns `(N,)` in (0, 1] and is 1 exactly at the reference.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poise.env.frame import Frame, Pose
from poise.spatial import into_heading, quat_between, quat_distance


def pose(frame: Frame, alpha: float = 2.0, weights: Tensor | None = None, half: bool = False) -> Tensor:
    """Eq. 8: exp(-alpha sum_j |b_j (-) b^_j|^2), |.| the rotation angle in rad.

    weights: `(J,)` per joint. half: the authors' code takes arccos|w|, half the angle.
    """
    angle = quat_distance(frame.sim.local, frame.ref.local)
    squared = (0.5 * angle if half else angle).square()
    return torch.exp(-alpha * (squared if weights is None else squared * weights).sum(-1))


def velocity(frame: Frame, alpha: float = 0.005, weights: Tensor | None = None) -> Tensor:
    """Eq. 9: exp(-alpha |q' - q^'|^2) over the hinges, rad/s. weights: `(n,)` per hinge."""
    error = frame.sim.qvel[:, 6:] - frame.ref.qvel[:, 6:]
    squared = error.square()
    return torch.exp(-alpha * (squared if weights is None else squared * weights).sum(-1))


def end_effectors(frame: Frame, bodies: Tensor, alpha: float = 5.0, local: bool = False) -> Tensor:
    """Eq. 10: exp(-alpha sum_e |g_e - g^_e|^2), m, world; `local`: in each one's own heading frame."""
    ours, theirs = (p.pos.index_select(1, bodies) for p in (frame.sim, frame.ref))
    if local:
        ours, theirs = _in_heading(frame.sim, ours), _in_heading(frame.ref, theirs)
    return torch.exp(-alpha * (ours - theirs).square().sum((-1, -2)))


def centre_of_mass(frame: Frame, alpha: float = 100.0) -> Tensor:
    """Eq. 11: exp(-alpha |c - c^|^2), m, world."""
    return torch.exp(-alpha * (frame.sim.com - frame.ref.com).square().sum(-1))


def root_pose(frame: Frame, alpha: float = 300.0, half: bool = False) -> Tensor:
    """Eq. 13: exp(-alpha ((y - y^)^2 + |o (-) o^|^2)), root height m and orientation rad.

    The orientations are compared with their headings removed, since all features are local.
    """
    height = frame.sim.pos[:, 0, 2] - frame.ref.pos[:, 0, 2]
    ours = quat_between(frame.sim.heading, frame.sim.quat[:, 0])
    theirs = quat_between(frame.ref.heading, frame.ref.quat[:, 0])
    angle = quat_distance(ours, theirs)
    angle = 0.5 * angle if half else angle
    return torch.exp(-alpha * (height.square() + angle.square()))


def root_velocity(frame: Frame, alpha: float = 0.1) -> Tensor:
    """Eq. 14: exp(-|l - l^|^2 - alpha |w - w^|^2), m/s and rad/s, each in its own heading frame."""
    ours, theirs = (
        into_heading(p.heading, torch.stack((p.qvel[:, :3], p.angvel[:, 0]), 1))
        for p in (frame.sim, frame.ref)
    )
    linear, angular = (ours - theirs).unbind(1)
    return torch.exp(-linear.square().sum(-1) - alpha * angular.square().sum(-1))


def residual(frame: Frame) -> Tensor:
    """Eqs. 3 and 5: the regularizer of the residual force, 1 without help."""
    return frame.reg


def _in_heading(pose_: Pose, points: Tensor) -> Tensor:
    """World points `(N, K, 3)` relative to the root in the character's heading frame."""
    return into_heading(pose_.heading, points - pose_.pos[:, :1])
