"""Forces and targets of a control step: actions, filtered, with help and events' forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.control import PDTargets, Residual, Wrench
from poise.env.evaluate import TensorFunction, record
from poise.env.events import Event
from poise.env.frame import hinge_torques
from poise.env.goal import Goal
from poise.env.recovery.clock import RecoveryClock
from poise.errors import PoiseError
from poise.sim import Backend, Drive, NanGuard

if TYPE_CHECKING:
    from poise.env.help import HelpBudget
    from poise.env.task import TaskConfig


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

    fused: recorded once, with and without help, and replayed as a whole. events: add forces, at the
    control and at the physics rate.
    """

    def __init__(
        self,
        backend: Backend,
        pd: PDTargets,
        residual: Residual | None,
        fused: bool,
        events: Sequence[Event] = (),
    ):
        self.events, self.backend, self.fused = events, backend, fused
        self.pd, self.residual = pd, residual
        self.hinges = backend.model.nu
        #: Bodies of the humanoid's table that the residual may push.
        self.bodies: tuple[int, ...] = getattr(residual, "bodies", (0,))
        self._places = torch.tensor([b + 1 for b in self.bodies], device=backend.device)
        # One for characters with help, one for those without.
        self.functions: dict[bool, TensorFunction] = {}
        # The targets at the end of the last control step, if they are interpolated.
        self.before_targets = torch.zeros_like(backend.drive.ctrl)

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

    def before(self) -> bool:
        """Adds the forces of events that hold for the control step; whether there are more, told anew
        before each physics step."""
        return any([event.before_step(self.backend.drive) for event in self.events])

    def held(self) -> tuple[Tensor, ...]:
        """What is in the drive, to begin each physics step with."""
        drive = self.backend.drive
        return drive.ctrl.clone(), drive.qfrc_applied.clone(), drive.xfrc_applied.clone()

    def substep(self, held: tuple[Tensor, ...], k: int, of: int) -> None:
        """Makes the drive what it is in physics step k `of` so many: what was `held`, with targets on
        their way and with the forces of events that are told anew."""
        drive = self.backend.drive
        if k:
            parts = drive.ctrl, drive.qfrc_applied, drive.xfrc_applied
            for part, value in zip(parts, held, strict=True):
                part.copy_(value)
        if self.pd.interpolate:
            torch.lerp(self.before_targets, held[0], (k + 1) / of, out=drive.ctrl)
            if k + 1 == of:
                self.before_targets.copy_(held[0])
        for event in self.events:
            event.before_substep(drive)

    def begin(self, fresh: Tensor) -> None:
        """Worlds `fresh (N,)` bool have no targets before those that are in the drive."""
        if self.pd.interpolate:
            torch.where(
                fresh[:, None], self.backend.drive.ctrl, self.before_targets, out=self.before_targets
            )

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


class Controls:
    """The actions of N characters, and what they make of them.

    Attributes:
        hinges: joint actions; the rest of an action is the residual's.
        num_actions: A.
        action: `(N, A)` the last one, as it acted.
        given: `(N, A)` the last one, as it was given; the same without `TaskConfig.filter`.
        before: `(N, A)` what acted in the step before.
        torque_before: `(N, n)` the hinges' torques at the begin of the last step, where terms read them.
        linvel_before: `(N, B, 3)` m/s, velocities of the bodies less the goal's then; the same.
        wrench: what the residual force was; None without one, and before the first step.
        actuation: fills the drive.
    """

    def __init__(
        self,
        task: TaskConfig,
        backend: Backend,
        humanoid: Humanoid,
        events: Sequence[Event],
        fused: bool,
    ):
        hinges = len(humanoid.hinges)
        if backend.model.nu != hinges:
            raise PoiseError(
                f"the model has {backend.model.nu} actuators, the body {hinges} hinges",
                code="count-differs",
            )
        self._task, self._backend, self.hinges = task, backend, hinges
        self.num_actions = hinges + (task.residual.dims if task.residual else 0)
        n, here = backend.num_envs, backend.device
        self.action = torch.zeros(n, self.num_actions, device=here)
        self.given, self.before = torch.zeros_like(self.action), torch.zeros_like(self.action)
        self.torque_before = torch.zeros(n, hinges, device=here)
        self.linvel_before = torch.zeros(n, len(humanoid.bodies), 3, device=here)
        self.wrench: Wrench | None = None
        self._recovery = next((event for event in events if isinstance(event, RecoveryClock)), None)
        self.actuation = Actuation(backend, task.pd, task.residual, fused, events)
        self._every = torch.arange(n, device=here)

    def apply(self, actions: Tensor, age: Tensor, goal: Goal, budget: HelpBudget, torques: bool) -> None:
        """Fills the drive for the next control step.

        actions: `(N, A)`. age: `(N,)` control steps since each episode began. torques: whether terms
        read `torque_before`.
        """
        want = self.action.shape
        if actions.shape != want:
            raise PoiseError(
                f"actions must be {tuple(want)}, got {tuple(actions.shape)}", code="wrong-shape"
            )
        self.before.copy_(self.action)
        if torques:
            forces = (self._backend.state[k] for k in ("qfrc_actuator", "qfrc_damper"))
            self.torque_before.copy_(hinge_torques(*forces))
        # A copy, since a restart clears its rows and the caller's actions are the caller's.
        self.given.copy_(actions)
        self.action.copy_(actions)
        if self._task.filter:
            keep_actions(self.action, self.before, self.kept(age), self.hinges)
        if self._task.guide is not None and budget.now > 0:
            self.action[:, self.hinges :] += self._task.guide(self._backend.state, goal)
        targets, rows = goal.targets()
        if self._recovery is not None and self._task.pd.mode == "additive":
            targets, rows = self._recovery.targets(targets[rows]), self._every
        left = budget.at(budget.group(goal))
        self.wrench = self.actuation.apply(self.action, targets, rows, left, budget.now > 0)
        self.actuation.begin(age == 0)

    def rows(self) -> dict[str, Tensor]:
        """Tensors `(N, ...)` by name that copies of worlds need beside the action."""
        return {"targets": self.actuation.before_targets} if self._task.pd.interpolate else {}

    def sources(self) -> dict[str, Tensor]:
        """What terms may read of the begin of the last step, by name."""
        before = {"torque_before": self.torque_before, "linvel_before": self.linvel_before}
        return {"action_before": self.before, **before}

    def step(self, worlds: Backend | NanGuard, substeps: int) -> None:
        """Physics steps of the worlds of these characters alone."""
        steps([self.actuation], worlds.step, substeps)

    def unfiltered(self, actions: Tensor, age: Tensor) -> Tensor:
        """What to give next so that `actions (N, A)` act in spite of the task's filter."""
        if not self._task.filter:
            return actions
        return unkept_actions(actions, self.action, self.kept(age), self.hinges)

    def kept(self, age: Tensor) -> Tensor:
        """`(N, 1)`, the share of the last action that the next one keeps."""
        return self._task.filter * (age > 0).to(self.action).unsqueeze(1)


def steps(drivers: Sequence[Actuation], step: Callable[[int], None], substeps: int) -> None:
    """One control step with what several drivers of the same worlds add to it.

    step: makes so many physics steps with what is in the drives.
    """
    varies = any([driver.before() for driver in drivers])
    if not varies and not any(driver.pd.interpolate for driver in drivers):
        step(substeps)
        return
    held = [driver.held() for driver in drivers]
    for k in range(substeps):
        for driver, values in zip(drivers, held, strict=True):
            driver.substep(values, k, substeps)
        step(1)
