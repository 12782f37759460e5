"""How the state after a control step depends on state and action before it, by finite differences.

The differences are not small: over a tenth of a radian a foot that hovers touches the floor
and one that sticks slides, so that the slope speaks of contacts that are not made yet, where the
derivative itself says that nothing below the foot matters. It is the average of the derivative over
the difference, a smoothing (Suh et al. 2022, "Bundled gradients through contact").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from poise.sim.cpu import CpuBackend
from poise.sim.tangent import difference, displaced


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The linear model of F control steps.

    The tangent state is `difference` of positions, then velocities; an action is targets, then a wrench
    on the root in units of its own.

    Attributes:
        a: `(F, 2 nv, 2 nv)` float32, how the tangent state after the step depends on that before it.
        b: `(F, 2 nv, nu + 6)` float32, how it depends on the action.
        qpos: `(F, nq)` float64, where the steps lead.
        qvel: `(F, nv)` float64, the velocities there.
    """

    a: np.ndarray
    b: np.ndarray
    qpos: Tensor
    qvel: Tensor


def linearise(
    backend: CpuBackend,
    qpos: Tensor,
    qvel: Tensor,
    action: Tensor,
    wrench_unit: Tensor,
    substeps: int,
    size: float,
) -> LinearModel:
    """Central differences around F states and actions.

    Args:
        backend: lends its worlds, of which it needs one for every difference, 2 (2 nv + nu + 6) + 1.
        qpos: `(F, nq)`, the states.
        qvel: `(F, nv)`, their velocities.
        action: `(F, nu + 6)`, targets (rad), then the root's wrench (force in world axes, torque in the
            root's own) in units of wrench_unit.
        wrench_unit: `(6)` N and N m.
        substeps: physics steps of a control step.
        size: of the differences, rad; half of it in m, ten times of it in rad/s and m/s, five times in
            targets and units of the wrench.
    """
    nv, nu = qvel.shape[1], action.shape[1]
    n, k = 2 * nv, 2 * nv + nu
    step = torch.full((k,), size, dtype=torch.float64)
    step[:3] *= 0.5
    step[nv:n] *= 10.0
    step[n:] *= 5.0
    moves = torch.cat((torch.zeros(1, k, dtype=torch.float64), torch.diag(step), torch.diag(-step)))
    per, frames = len(moves), len(qpos)
    chunk = max(1, backend.num_envs // per)
    a, b = np.zeros((frames, n, n), np.float32), np.zeros((frames, n, nu), np.float32)
    q_next, v_next = torch.empty_like(qpos), torch.empty_like(qvel)
    for begin in range(0, frames, chunk):
        rows = slice(begin, min(begin + chunk, frames))
        count = rows.stop - begin
        by = moves.repeat(count, 1)
        q = displaced(qpos[rows].repeat_interleave(per, 0), by[:, :nv])
        v = qvel[rows].repeat_interleave(per, 0) + by[:, nv:n]
        u = action[rows].repeat_interleave(per, 0) + by[:, n:]
        q, v = backend.successors(q, v, *driven(u, nv, wrench_unit), substeps)
        q, v = q.view(count, per, -1), v.view(count, per, -1)
        q_next[rows], v_next[rows] = q[:, 0], v[:, 0]
        still = q[:, :1].expand(-1, per - 1, -1).reshape(count * (per - 1), -1)
        moved = difference(q[:, 1:].reshape(count * (per - 1), -1), still).view(count, per - 1, nv)
        end = torch.cat((moved, v[:, 1:] - v[:, :1]), -1)
        slope = (end[:, :k] - end[:, k:]) / (2.0 * step)[:, None]
        # Where a displaced world went bad nothing is known.
        slope = torch.nan_to_num(slope, 0.0, 0.0, 0.0).transpose(1, 2).numpy()
        a[rows], b[rows] = slope[:, :, :n], slope[:, :, n:]
    return LinearModel(a, b, q_next, v_next)


def driven(action: Tensor, nv: int, wrench_unit: Tensor) -> tuple[Tensor, Tensor]:
    """Actuator targets `(N, nu)` and generalized forces `(N, nv)` of actions `(N, nu + 6)`."""
    applied = action.new_zeros(len(action), nv)
    applied[:, :6] = action[:, -6:] * wrench_unit
    return action[:, :-6], applied
