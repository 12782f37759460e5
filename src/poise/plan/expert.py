"""A scripted expert: inverse dynamics of the reference, and feedback on the root within the help limit.

It needs no learning and follows most clips, so that a policy can start by imitating it
(`poise.learn.clone`) where exploring from nothing would take minutes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from poise.control import ExplicitResidual
from poise.env.env import ImitationEnv
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.plan.clearance import ClearanceRule, clearance
from poise.plan.guide import Guide, Spring
from poise.plan.inverse_dynamics import ContactRule, InverseDynamics, inverse_dynamics, step_midpoints
from poise.spatial import heading_quat, quat_rotate_inv


@dataclass(frozen=True)
class ExpertConfig:
    """How the expert acts.

    Attributes:
        spring: by which the root is pulled.
        lead: place in a control step from which the joint targets are taken, 0 its begin, 1 its end.
        contacts: which points may carry weight in the inverse dynamics.
        clear: how swinging feet are lifted.
    """

    spring: Spring = field(default_factory=Spring)
    lead: float = 0.5
    contacts: ContactRule = field(default_factory=ContactRule)
    clear: ClearanceRule = field(default_factory=ClearanceRule)


@dataclass(frozen=True, eq=False)
class Plan:
    """Inverse dynamics of every step of a reference; row r leads from frame r to the next.

    Attributes:
        torque: `(F, n)` N m per hinge.
        force_h: `(F, 3)` N, root residual in the reference root's heading frame at the step's begin.
        torque_b: `(F, 3)` N m, in the root's axes.
        lift: `(F, n)` rad, added to the frame's hinge angles so that swinging feet clear the floor;
            float32.
        parts: what was solved, clip by clip.
    """

    torque: Tensor
    force_h: Tensor
    torque_b: Tensor
    lift: Tensor
    parts: tuple[InverseDynamics, ...]


def make_plan(reference: Reference, config: ExpertConfig | None = None) -> Plan:
    """Solves all steps of all clips; a last frame, which no step leaves, repeats the one before."""
    config = config or ExpertConfig()
    parts: list[InverseDynamics] = []
    torque, force, turn, lift = [], [], [], []
    of_clips = (reference.start.tolist(), reference.length.tolist(), reference.body.tolist())
    for start, length, body in zip(*of_clips, strict=True):
        model = reference.bodies[body].model
        rows = slice(start, start + length)
        qpos, qvel = reference.qpos[rows].numpy(), reference.qvel[rows].numpy()
        steps = step_midpoints(model, qpos, qvel, reference.rate_hz)
        part = inverse_dynamics(model, *steps, config.contacts)
        lift.append(torch.tensor(clearance(model, qpos, qvel, config.clear)).float())
        parts.append(part)
        for rows_, value in ((torque, part.torque), (force, part.root_force), (turn, part.root_torque)):
            rows_.append(torch.tensor(np.concatenate((value, value[-1:]))).float())
    force_h = quat_rotate_inv(heading_quat(reference.qpos[:, 3:7].float()), torch.cat(force))
    return Plan(torch.cat(torque), force_h, torch.cat(turn), torch.cat(lift), tuple(parts))


class Expert:
    """Acts in one `ImitationEnv` with full knowledge of its state, whatever its observation is.

    A teacher for `poise.learn.clone`, and a policy that `poise.eval` can score.

    Raises:
        PoiseError: explicit residual forces that do not reach the root.
    """

    def __init__(self, env: ImitationEnv, config: ExpertConfig | None = None, plan: Plan | None = None):
        self.env, self.config = env, config or ExpertConfig()
        self.plan = plan or make_plan(env.reference, self.config)
        self._residual = env.task.residual
        if isinstance(self._residual, ExplicitResidual) and 0 not in self._residual.bodies:
            raise PoiseError("the expert needs a residual force on the root, body row 0")
        model = env.backend.model
        # The servos of each body, `(S, n)`.
        models = [model, *(h.model for h in env.reference.bodies[1:])]
        self._kp = torch.stack([torch.tensor(m.actuator_gainprm[:, 0]).float() for m in models])
        self._most = torch.stack([torch.tensor(m.actuator_forcerange[:, 1]).float() for m in models])
        self._guide = None
        if self._residual is not None:
            path = self.plan.force_h, self.plan.torque_b
            self._guide = Guide(env.reference, self._residual, *path, self.config.spring)

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for the worlds as they stand now; `obs` is not looked at."""
        env = self.env
        rows = env.reference.rows(env.clip, env.frame)
        joints = self._joints(rows)
        if self._guide is not None:
            qpos, qvel = env.backend.state.qpos, env.backend.state.qvel
            joints = torch.cat((joints, self._guide.action(qpos, qvel, env.goal_pose(), rows)), -1)
        return env.unfiltered(joints)

    def _joints(self, rows: Tensor) -> Tensor:
        """Targets u = q_ref + tau / kp, with kp (u - q) inside the torque limits, as actions."""
        env, reference = self.env, self.env.reference
        ahead = reference.rows(env.clip, env.frame + 1)
        now, then = reference.qpos[rows, 7:].float(), reference.qpos[ahead, 7:].float()
        plan, lead = self.plan, self.config.lead
        path = torch.lerp(now + plan.lift[rows], then + plan.lift[ahead], lead)
        body = reference.body[env.clip]
        kp = self._kp[body]
        target = path + plan.torque[rows] / kp
        q, reach = env.backend.state.qpos[:, 7:].float(), self._most[body] / kp
        target = torch.maximum(torch.minimum(target, q + reach), q - reach)
        return env.task.pd.action(target, then)
