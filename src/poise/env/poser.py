"""Coordinates of one humanoid as poses."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid, make_spec
from poise.env.frame import Layout, Pose
from poise.env.recording import Recorded
from poise.kin import Kinematics
from poise.spatial import heading_quat, quat_rotate

#: Bodies in the one model that makes poses of many frames: a call is for so many at once.
MANY = 16


class Poser:
    """Makes poses of coordinates of one humanoid.

    kinematics: float64, on the CPU. device: where `local` works in float32.
    """

    def __init__(self, humanoid: Humanoid, device: torch.device | str = "cpu"):
        self.humanoid = humanoid
        self.kinematics = Kinematics(humanoid.table)
        self._fast = Kinematics(humanoid.table, torch.float32, device)
        self._made: dict[int, tuple[Any, ...]] = {}
        self._turned = Recorded(self._turns)

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
        """The same poses by MuJoCo: for the frames that become known in a step, for which torch takes
        longer. What a frame's pose is does not depend on the others, to the last bit."""
        frames, n = len(qpos), len(self.humanoid.bodies)
        pos, quat, centres, cvel = (np.empty((frames, *k)) for k in ((n, 3), (n, 4), (3,), (n, 6)))
        made, at, q, v = (pos, quat, centres, cvel), 0, qpos.numpy(), qvel.numpy()
        for count, (model, data, at_q, at_v, *views) in zip(
            (MANY, 1), self._worlds(frames), strict=True
        ):
            to = at + (frames - at) // count * count
            # Attributes of MjData are made anew at every access, which takes longer than the kinematics.
            for i in range(at, to, count):
                at_q[:], at_v[:] = q[i : i + count], v[i : i + count]
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_comVel(model, data)
                for out, view in zip(made, views, strict=True):
                    out[i : i + count] = view
            at = to
        turning, moving = cvel[..., :3], cvel[..., 3:]
        # v(xpos) = v(c) + omega x (xpos - c), see `sim.body_linear_velocity_w`.
        arm = pos - centres[:, None]
        for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            moving[..., k] += turning[..., i] * arm[..., j] - turning[..., j] * arm[..., i]
        small, local, heading = self._turned(qpos)
        arrays = (pos, quat, moving, turning, centres)
        at_pos, at_quat, linvel, angvel, com = (torch.from_numpy(x) for x in arrays)
        return Pose(
            small,
            qvel.float(),
            at_pos.float(),
            at_quat.float(),
            linvel.float(),
            angvel.float(),
            com.float(),
            local,
            heading,
        )

    def _turns(self, qpos: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        small = qpos.float()
        return small, self.local(small), heading_quat(small[:, 3:7])

    def _worlds(self, frames: int) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Models and data of `MANY` bodies and of one, with views of what goes in and comes out; the
        former only for so many frames."""
        one = self._world(1)
        return (self._world(MANY) if frames >= MANY else one), one

    def _world(self, count: int) -> tuple[Any, ...]:
        if count not in self._made:
            model = self.humanoid.model
            if count > 1:
                model = make_spec(self.humanoid.table, count).compile()
            data, n = mujoco.MjData(model), len(self.humanoid.bodies)
            bodies = (x[1:].reshape(count, n, -1) for x in (data.xpos, data.xquat, data.cvel))
            at_pos, at_quat, at_cvel = bodies
            self._made[count] = (
                model, data, data.qpos.reshape(count, -1), data.qvel.reshape(count, -1), at_pos, at_quat,
                data.subtree_com[1::n], at_cvel,
            )  # fmt: skip
        return self._made[count]

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
