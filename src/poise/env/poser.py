"""Coordinates of one humanoid as poses."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.frame import Layout, Pose
from poise.kin import Kinematics
from poise.spatial import heading_quat, quat_rotate


class Poser:
    """Makes poses of coordinates of one humanoid.

    kinematics: float64, on the CPU. device: where `local` works in float32.
    """

    def __init__(self, humanoid: Humanoid, device: torch.device | str = "cpu"):
        self.humanoid = humanoid
        self.kinematics = Kinematics(humanoid.table)
        self._fast = Kinematics(humanoid.table, torch.float32, device)

    def __call__(self, qpos: Tensor, qvel: Tensor) -> Pose:
        """The poses of `qpos (F, 7 + n)` and `qvel (F, 6 + n)`, float64."""
        body = self.kinematics(qpos, qvel)
        return Pose(
            qpos.float(),
            qvel.float(),
            body.pos.float(),
            body.quat.float(),
            body.linvel.float(),
            body.angvel.float(),
            _centre_of_mass(self.humanoid, body.pos, body.quat),
            self.local(qpos.float()),
            heading_quat(qpos[:, 3:7].float()),
        )

    def local(self, qpos: Tensor) -> Tensor:
        """`(F, J, 4)` wxyz local turns of hinged bodies."""
        return self._fast.local_quats(qpos)

    def layout(self) -> Layout:
        """Where the numbers of this humanoid's poses stand in packed rows."""
        qpos = torch.zeros(1, self.humanoid.model.nq, dtype=torch.float64)
        qpos[:, 3] = 1.0
        return Layout(self(qpos, torch.zeros(1, self.humanoid.model.nv, dtype=torch.float64)))


def _centre_of_mass(humanoid: Humanoid, pos: Tensor, quat: Tensor) -> Tensor:
    """`(F, 3)` float32 m of the body's parts, as its compiled model has them."""
    mass = torch.tensor(humanoid.model.body_mass[1:])
    inertial = torch.tensor(humanoid.model.body_ipos[1:])
    centre = pos + quat_rotate(quat, inertial.expand_as(pos))
    return ((centre * mass[:, None]).sum(-2) / mass.sum()).float()
