"""A scripted expert: inverse dynamics of the reference, and feedback on the root within the help limit.

It needs no learning and follows most clips, so that a policy can start by imitating it
(`poise.learn.clone`) where exploring from nothing would take minutes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.control import ExplicitResidual, ImplicitResidual
from poise.env.env import ImitationEnv
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.plan.clearance import ClearanceRule, clearance
from poise.plan.inverse_dynamics import ContactRule, InverseDynamics, inverse_dynamics, step_midpoints
from poise.spatial import heading_quat, quat_conj, quat_mul, quat_rotate, quat_rotate_inv, quat_to_rotvec


@dataclass(frozen=True)
class ExpertConfig:
    """How the expert pulls the root along.

    The root's spring has the stiffness m w^2 and the damping 2 z m w for a character of mass m, so that
    heavy and light characters follow alike; about the root's axes the moment of inertia takes the
    place of m.

    Attributes:
        frequency: rad/s, w of the root's place.
        damping: z, ratio of critical damping of the root's place.
        turn_frequency: rad/s, w about the root's axes.
        turn_damping: z about the root's axes.
        lead: place in a control step from which the joint targets are taken, 0 its begin, 1 its end.
        contacts: which points may carry weight in the inverse dynamics.
        clear: how swinging feet are lifted.
    """

    frequency: float = 5.0
    damping: float = 0.4
    turn_frequency: float = 14.0
    turn_damping: float = 0.1
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
        mass, inertia = float(model.body_subtreemass[1]), _turning_inertia(env.reference)
        c = self.config
        self._gains = (
            mass * c.frequency**2,
            2 * c.damping * mass * c.frequency,
            inertia * c.turn_frequency**2,
            2 * c.turn_damping * inertia * c.turn_frequency,
        )

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for the worlds as they stand now; `obs` is not looked at."""
        env = self.env
        rows = env.reference.rows(env.clip, env.frame)
        joints = self._joints(rows)
        if self._residual is not None:
            joints = torch.cat((joints, self._help(rows)), -1)
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

    def _help(self, rows: Tensor) -> Tensor:
        """The root wrench as residual action: planned part and spring, cut to the limits."""
        env, residual = self.env, self._residual
        state, ref = env.backend.state, env.goal_pose()
        qpos, qvel = state.qpos[:, :7].float(), state.qvel[:, :6].float()
        k, d, k_turn, d_turn = self._gains
        quat, ref_quat = qpos[:, 3:7], ref.qpos[:, 3:7]
        # F = F_ID + K (p^ - p) + D (v^ - v), world axes
        force = quat_rotate(ref.heading, self.plan.force_h[rows])
        force = force + k * (ref.qpos[:, :3] - qpos[:, :3]) + d * (ref.qvel[:, :3] - qvel[:, :3])
        # T = T_ID + K log(q^-1 q^) + D (w^ - w), the root's axes
        turn = quat_mul(quat_conj(quat), ref_quat)
        spin = quat_rotate(turn, ref.qvel[:, 3:6]) - qvel[:, 3:6]
        torque = (
            quat_rotate(turn, self.plan.torque_b[rows]) + k_turn * quat_to_rotvec(turn) + d_turn * spin
        )
        assert residual is not None
        explicit = not isinstance(residual, ImplicitResidual)
        frame = quat if explicit else heading_quat(quat)
        unit = torch.cat(
            (
                _within(quat_rotate_inv(frame, force), residual.limit_n),
                _within(torque, residual.limit_nm),
            ),
            -1,
        )
        if not explicit:
            return unit
        out = unit.new_zeros(len(unit), residual.dims)
        at = 9 * residual.bodies.index(0) if isinstance(residual, ExplicitResidual) else 0
        out[:, at + 3 : at + 9] = unit
        return out


def _within(vector: Tensor, limit: float) -> Tensor:
    """`vector (N, 3)` in units of the limit, no longer than 1; zero without any help."""
    if limit == 0.0:
        return torch.zeros_like(vector)
    unit = vector / limit
    return unit / unit.norm(dim=-1, keepdim=True).clamp_min(1.0)


def _turning_inertia(reference: Reference) -> float:
    """Mean moment of inertia of the whole body about the root in the first frame, kg m^2."""
    model = reference.humanoid.model
    data = mujoco.MjData(model)
    data.qpos[:] = reference.qpos[0].numpy()
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return float(np.trace(mass[3:6, 3:6])) / 3
