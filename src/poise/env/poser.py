"""Coordinates of one humanoid as poses."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import mujoco
import numpy as np
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

    def live(self, qpos: Tensor, qvel: Tensor) -> Pose:
        """The same poses by MuJoCo, one after another: for the few frames that become known in a step,
        for which torch takes milliseconds. What a frame's pose is does not depend on the others."""
        model, (data, *views) = self.humanoid.model, self._data
        at_q, at_v, at_pos, at_quat, at_com, at_cvel = views
        frames, n = len(qpos), model.nbody
        pos, quat, centres, cvel = (np.empty((frames, *k)) for k in ((n, 3), (n, 4), (3,), (n, 6)))
        # Attributes of MjData are made anew at every access, which takes longer than the kinematics.
        for i, (q, v) in enumerate(zip(qpos.numpy(), qvel.numpy(), strict=True)):
            at_q[:], at_v[:] = q, v
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            pos[i], quat[i], centres[i], cvel[i] = at_pos, at_quat, at_com, at_cvel
        turning, moving = cvel[:, 1:, :3], cvel[:, 1:, 3:]
        # v(xpos) = v(c) + omega x (xpos - c), see `sim.body_linear_velocity_w`.
        arm = pos[:, 1:] - centres[:, None]
        out = np.concatenate((pos[:, 1:], quat[:, 1:], moving + np.cross(turning, arm), turning), -1)
        at, turned, linvel, angvel = torch.from_numpy(out).float().split((3, 4, 3, 3), -1)
        small = qpos.float()
        return Pose(
            small,
            qvel.float(),
            at,
            turned,
            linvel,
            angvel,
            torch.from_numpy(centres).float(),
            self.local(small),
            heading_quat(small[:, 3:7]),
        )

    @cached_property
    def _data(self) -> tuple[Any, ...]:
        """Data of the body's model, and views of what goes in and comes out."""
        data = mujoco.MjData(self.humanoid.model)
        return data, data.qpos, data.qvel, data.xpos, data.xquat, data.subtree_com[1], data.cvel

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
