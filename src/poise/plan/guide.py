"""A hand that leads the root along its motion, as far as the residual force's limit goes: the help of a
scripted expert, and of a policy that learns while this help fades.

    F = F_ID + K (p^ - p) + D (v^ - v)        world axes
    T = T_ID + K log(q^-1 q^) + D (w^ - w)    the root's own axes

F_ID and T_ID are what inverse dynamics asks for, p, q the root's place and rotation, ^ the reference's.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.control import ExplicitResidual, ImplicitResidual, Residual
from poise.env.frame import Pose
from poise.env.goal import Goal
from poise.env.reference import Reference
from poise.motion.rotations import (
    heading_quat,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inv,
    quat_to_rotvec,
)
from poise.sim import SimState


@dataclass(frozen=True)
class Spring:
    """How the root is pulled along.

    The spring has the stiffness m w^2 and the damping 2 z m w for a character of mass m, so that heavy
    and light characters follow alike; about the root's axes the moment of inertia takes the place of m.

    Attributes:
        frequency: rad/s, w of the root's place.
        damping: z, ratio of critical damping of the root's place.
        turn_frequency: rad/s, w about the root's axes.
        turn_damping: z about the root's axes.
    """

    frequency: float = 5.0
    damping: float = 0.4
    turn_frequency: float = 14.0
    turn_damping: float = 0.1


class Guide:
    """Residual actions that lead the root; it satisfies `env.task.Guides`.

    Args:
        reference: the motions.
        residual: the kind of force; an explicit one reaches the root.
        force_h, torque_b: `(F, 3)` N and N m of each step of the reference, from inverse dynamics, see
            `plan.expert.Plan`.
    """

    def __init__(
        self,
        reference: Reference,
        residual: Residual,
        force_h: Tensor,
        torque_b: Tensor,
        spring: Spring | None = None,
    ):
        self.residual, self.force_h, self.torque_b = residual, force_h, torque_b
        s = spring or Spring()
        mass = float(reference.humanoid.model.body_subtreemass[1])
        inertia = _turning_inertia(reference)
        self._gains = (
            mass * s.frequency**2,
            2 * s.damping * mass * s.frequency,
            inertia * s.turn_frequency**2,
            2 * s.turn_damping * inertia * s.turn_frequency,
        )

    def __call__(self, state: SimState, goal: Goal) -> Tensor:
        """Residual actions `(N, dims)` for the worlds as they stand."""
        clips = goal.clips
        rows = clips.reference.rows(clips.clip, clips.frame)
        if self.force_h.device != rows.device:
            self.force_h, self.torque_b = self.force_h.to(rows.device), self.torque_b.to(rows.device)
        return self.action(state.qpos, state.qvel, goal.layout.unpacked(goal.now()), rows)

    def action(self, qpos: Tensor, qvel: Tensor, ref: Pose, rows: Tensor) -> Tensor:
        """The root wrench as residual action: planned part and spring, cut to the limits.

        Args:
            qpos, qvel: `(N, 7 + n)` and `(N, 6 + n)` of the characters. ref: what they are to do now.
            rows: `(N,)` of the reference's steps.
        """
        residual = self.residual
        qpos, qvel = qpos[:, :7].float(), qvel[:, :6].float()
        k, d, k_turn, d_turn = self._gains
        quat, ref_quat = qpos[:, 3:7], ref.qpos[:, 3:7]
        # F = F_ID + K (p^ - p) + D (v^ - v), world axes
        force = quat_rotate(ref.heading, self.force_h[rows])
        force = force + k * (ref.qpos[:, :3] - qpos[:, :3]) + d * (ref.qvel[:, :3] - qvel[:, :3])
        # T = T_ID + K log(q^-1 q^) + D (w^ - w), the root's axes
        turn = quat_mul(quat_conj(quat), ref_quat)
        spin = quat_rotate(turn, ref.qvel[:, 3:6]) - qvel[:, 3:6]
        torque = quat_rotate(turn, self.torque_b[rows]) + k_turn * quat_to_rotvec(turn) + d_turn * spin
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
