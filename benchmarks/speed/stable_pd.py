"""The paper's controller as physics: explicit stable PD torques, worked out anew every physics step."""

from __future__ import annotations

import copy

import mujoco
import torch
from torch import Tensor

from poise.control import stable_pd_torque
from poise.sim import CpuBackend


class StablePDBackend(CpuBackend):
    """Worlds with actuators that are replaced by `control.stable_pd_torque` (Tan et al. 2011).

    Gains, damping and torque limits are those of the model's position servos and joints; `drive.ctrl`
    still holds target angles. Thousands of linear solves a second make it a reference for short
    evaluations, not a place to train.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, threads: int = 0) -> None:
        model = copy.copy(model)
        self._kp = torch.tensor(model.actuator_gainprm[:, 0].copy())
        limit = torch.tensor(model.actuator_forcerange[:, 1].copy())
        limited = torch.tensor(model.actuator_forcelimited.astype(bool))
        self._limit = torch.where(limited, limit, torch.inf)
        self._kd = torch.tensor(model.dof_damping[6:].copy())
        model.actuator_gainprm[:] = 0.0
        model.actuator_biasprm[:] = 0.0
        model.dof_damping[6:] = 0.0
        super().__init__(model, num_envs, threads)
        self.state.bind(["M", "qfrc_bias"])
        # MuJoCo keeps the lower triangle of the inertia row by row, without its zeros.
        rows = torch.arange(model.nv).repeat_interleave(torch.tensor(model.M_rownnz).long())
        self._places = rows, torch.tensor(model.M_colind).long()

    def _inertia(self) -> Tensor:
        nv = self.model.nv
        full = torch.zeros(self.num_envs, nv, nv, dtype=torch.float64)
        rows, columns = self._places
        full[:, rows, columns] = self.state["M"]
        full[:, columns, rows] = self.state["M"]
        return full

    def step(self, nstep: int = 1) -> None:
        held, dt = self.drive.qfrc_applied.clone(), self.model.opt.timestep
        for _ in range(nstep):
            torque = stable_pd_torque(
                self._inertia(),
                self.state["qfrc_bias"],
                self._kp,
                self._kd,
                self.state.qpos[:, 7:],
                self.state.qvel,
                self.drive.ctrl,
                dt,
                self._limit,
            )
            self.drive.qfrc_applied.copy_(held)
            self.drive.qfrc_applied[:, 6:].add_(torque)
            super().step(1)
        self.drive.qfrc_applied.copy_(held)
