"""Actions turned into what drives the characters."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from poise.control import PDTargets, Residual, Wrench
from poise.env.plugins import Plugin
from poise.env.recording import TensorFunction, record
from poise.sim import Backend, Drive


def keep_actions(actions: Tensor, last: Tensor, kept: Tensor, hinges: int) -> None:
    """Filters the hinges' part of `actions (N, A)` in place, by the share `kept (N, 1)` of the `last`:
    a_t = (1 - f) u_t + f a_(t-1)."""
    actions[:, :hinges] = torch.lerp(actions, last, kept)[:, :hinges]


def unkept_actions(actions: Tensor, last: Tensor, kept: Tensor, hinges: int) -> Tensor:
    """What `keep_actions` makes `actions (N, A)` of, u_t = (a_t - f a_(t-1)) / (1 - f)."""
    joints = ((actions - kept * last) / (1.0 - kept))[:, :hinges]
    return torch.cat((joints, actions[:, hinges:]), 1)


class Actuation:
    """Fills a backend's drive from actions of `hinges` joint actions followed by the residual's.

    fused: recorded once, with and without help, and replayed as a whole. pushing, pushing_substeps:
    plug-ins that add forces, at the control and at the physics rate.
    """

    def __init__(
        self,
        backend: Backend,
        pd: PDTargets,
        residual: Residual | None,
        fused: bool,
        pushing: Sequence[Plugin] = (),
        pushing_substeps: Sequence[Plugin] = (),
    ):
        self.pushing, self.pushing_substeps = pushing, pushing_substeps
        self.backend, self.pd, self.residual, self.fused = backend, pd, residual, fused
        self.hinges = backend.model.nu
        #: Bodies of the humanoid's table that the residual may push.
        self.bodies: tuple[int, ...] = getattr(residual, "bodies", (0,))
        self._places = torch.tensor([b + 1 for b in self.bodies], device=backend.device)
        # One for characters with help, one for those without.
        self.functions: dict[bool, TensorFunction] = {}

    def apply(
        self, action: Tensor, targets: Tensor, rows: Tensor, scale: Tensor, helped: bool
    ) -> Wrench | None:
        """Drives all worlds by `action (N, A)`; the wrench of the residual, None without one.

        targets: the reference's hinge angles, of which the rows `rows (N)` are aimed at. scale: what is
        left of the residual's limits. helped: whether any is.
        """
        state, drive, residual = self.backend.state, self.backend.drive, self.residual
        given = (
            action,
            targets,
            rows,
            state.xpos,
            state.xquat,
            state.xipos,
            drive.ctrl,
            drive.qfrc_applied,
            drive.xfrc_applied,
            scale,
        )
        helped = helped and residual is not None and residual.limit_n + residual.limit_nm > 0
        if helped not in self.functions:
            plain = self.with_help if helped else self.without_help
            self.functions[helped] = record(plain, given) if self.fused else plain
        force, torque, point = self.functions[helped](*given)
        return None if residual is None else Wrench(force, torque, point, self.bodies)

    def push(self) -> None:
        """Adds the forces of plug-ins that hold for the control step."""
        for plugin in self.pushing:
            plugin.push(self.backend.drive)

    def held(self) -> tuple[Tensor, ...]:
        """What is in the drive, to begin each physics step with."""
        drive = self.backend.drive
        return drive.ctrl.clone(), drive.qfrc_applied.clone(), drive.xfrc_applied.clone()

    def push_substep(self, held: tuple[Tensor, ...] | None) -> None:
        """Adds the forces of plug-ins that are told anew before each physics step to what was `held`;
        None where that is in the drive already."""
        drive = self.backend.drive
        if held is not None:
            parts = drive.ctrl, drive.qfrc_applied, drive.xfrc_applied
            for part, value in zip(parts, held, strict=True):
                part.copy_(value)
        for plugin in self.pushing_substeps:
            plugin.push_substep(drive)

    def with_help(
        self, action: Tensor, targets: Tensor, rows: Tensor, *state: Tensor
    ) -> tuple[Tensor, ...]:
        """Fills the drive, which `state` holds, anew; the wrench's force, torque and point."""
        self.without_help(action, targets, rows, *state)
        xpos, xquat, xipos, *applied, scale = state
        assert self.residual is not None
        force, torque, point, self.bodies = self.residual.apply(
            action[:, self.hinges :], xpos, xquat, xipos, Drive(*applied), scale
        )
        return force, torque, point

    def without_help(
        self, action: Tensor, targets: Tensor, rows: Tensor, *state: Tensor
    ) -> tuple[Tensor, ...]:
        """The same where no help is left: a wrench of nothing."""
        drive, joints = Drive(*state[3:6]), action[:, : self.hinges]
        drive.clear()
        self.pd.apply(joints, targets.index_select(0, rows), drive)
        point = state[0][:, self._places].to(joints.dtype)
        nothing = torch.zeros_like(point)
        return nothing, nothing, point
