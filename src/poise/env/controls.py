"""What drives the characters in a control step: actions, filtered, with help and plug-ins' forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.control import Wrench
from poise.env.actuation import Actuation, keep_actions, unkept_actions
from poise.env.goals.goal import Goal
from poise.env.help import HelpBudget
from poise.env.observables import hinge_torques
from poise.env.plugins import Plugin
from poise.env.task import TaskConfig
from poise.errors import PoiseError
from poise.sim import Backend, NanGuard


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
        plugins: Sequence[Plugin],
        fused: bool,
    ):
        hinges = len(humanoid.hinges)
        if backend.model.nu != hinges:
            raise PoiseError(f"the model has {backend.model.nu} actuators, the body {hinges} hinges")
        self._task, self._backend, self.hinges = task, backend, hinges
        self.num_actions = hinges + (task.residual.dims if task.residual else 0)
        n, here = backend.num_envs, backend.device
        self.action = torch.zeros(n, self.num_actions, device=here)
        self.given, self.before = torch.zeros_like(self.action), torch.zeros_like(self.action)
        self.torque_before = torch.zeros(n, hinges, device=here)
        self.linvel_before = torch.zeros(n, len(humanoid.bodies), 3, device=here)
        self.wrench: Wrench | None = None
        # Only plug-ins that change a hook are asked by it.
        self._targeting, *pushing = (
            tuple(p for p in plugins if getattr(type(p), hook) is not getattr(Plugin, hook))
            for hook in ("targets", "push", "push_substep")
        )
        self.actuation = Actuation(backend, task.pd, task.residual, fused, *pushing)
        self._every = torch.arange(n, device=here)

    def apply(self, actions: Tensor, age: Tensor, goal: Goal, budget: HelpBudget, torques: bool) -> None:
        """Fills the drive for the next control step.

        actions: `(N, A)`. age: `(N,)` control steps since each episode began. torques: whether terms
        read `torque_before`.
        """
        want = self.action.shape
        if actions.shape != want:
            raise PoiseError(f"actions must be {tuple(want)}, got {tuple(actions.shape)}")
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
        if self._targeting and self._task.pd.mode == "additive":
            targets, rows = targets[rows], self._every
            for plugin in self._targeting:
                targets = plugin.targets(targets)
        left = budget.at(goal.group(self._task.help_by))
        self.wrench = self.actuation.apply(self.action, targets, rows, left, budget.now > 0)

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
    for driver in drivers:
        driver.push()
    if not any(plugin.busy() for driver in drivers for plugin in driver.pushing_substeps):
        step(substeps)
        return
    held = [driver.held() for driver in drivers]
    for k in range(substeps):
        for driver, values in zip(drivers, held, strict=True):
            driver.push_substep(values if k else None)
        step(1)
