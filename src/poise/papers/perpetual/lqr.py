"""Feedback along given motions: linear models of their control steps, and the linear-quadratic regulator
of every step, many motions at once.

How the state after a control step depends on state and action before it is found by finite differences.
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

from poise.errors import PoiseError
from poise.sim.cpu import CpuBackend
from poise.sim.mechanics import difference, displaced


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


@dataclass(frozen=True, eq=False)
class Regulator:
    """What to do at each of F rows when the state is off by d: change the action by k + K d.

    From a row on d^T P d / 2 + p^T d more is to pay than with d = 0 and no change.

    Attributes:
        feedback: `(F, m, n)` float32, K; zero in last rows.
        forward: `(F, m)` float32, k; zero in last rows.
        value: `(F, n, n)` float32, P.
        slope: `(F, n)` float64, p.
    """

    feedback: np.ndarray
    forward: np.ndarray
    value: np.ndarray
    slope: np.ndarray


def regulate(
    a: np.ndarray,
    b: np.ndarray,
    gap: np.ndarray,
    error: np.ndarray,
    effort: np.ndarray,
    state_price: np.ndarray,
    action_price: np.ndarray,
    lengths: np.ndarray,
    damping: np.ndarray | None = None,
) -> Regulator:
    """Solves the affine linear-quadratic problem of each motion backwards from its end.

        d[t + 1] = A d[t] + B c[t] + gap[t]
        min sum_t |error[t] + d[t]|^2_Q + |effort[t] + c[t]|^2_R + damping (|d[t]|^2_Q + |c[t]|^2_R)

    which is the backward pass of iLQR (Li and Todorov 2004) with the gaps of multiple shooting
    (Giftthaler et al. 2018), each over 2; damping keeps a step short where the linear model is poor.

    Args:
        a: `(F, n, n)`, how the next state depends on the state; last rows have none.
        b: `(F, n, m)`, how it depends on the action.
        gap: `(F, n)`, by how much a step misses the next row's state.
        error: `(F, n)`, of the rows' states.
        effort: `(F, m)`, of their actions.
        state_price: `(n)`, diagonal of Q.
        action_price: `(F, m)`, diagonal of R.
        lengths: `(C,)` rows of each motion; the motions follow one another.
        damping: `(F,)`, none by default.

    Raises:
        PoiseError: the lengths do not add up to the rows.
    """
    rows, n, m = b.shape
    if int(np.sum(lengths)) != rows:
        raise PoiseError(
            f"the motions have {int(np.sum(lengths))} rows, and {rows} are given",
            "regulate",
            code="count-differs",
        )
    damping = np.zeros(rows) if damping is None else damping
    out = Regulator(
        np.zeros((rows, m, n), np.float32), np.zeros((rows, m), np.float32),
        np.zeros((rows, n, n), np.float32), np.zeros((rows, n)),
    )  # fmt: skip
    # Long motions first, so that the motions with a j-th row from the end are the first few.
    order = np.argsort(-lengths, kind="stable")
    size, start = lengths[order], (np.cumsum(lengths) - lengths)[order]
    last = start + size - 1
    value = np.tile(np.diag(state_price), (len(size), 1, 1))
    slope = error[last] * state_price
    out.value[last], out.slope[last] = value, slope
    own_n, own_m = np.arange(n), np.arange(m)
    for j in range(1, int(size.max())):
        here = int((size > j).sum())
        r = last[:here] - j
        at, bt, damp = a[r].astype(np.float64), b[r].astype(np.float64), 1.0 + damping[r, None]
        p_next, s_next = value[:here], slope[:here]
        price = action_price[r]
        ahead = s_next + np.einsum("cij,cj->ci", p_next, gap[r])
        pb = p_next @ bt
        quu, qux = bt.transpose(0, 2, 1) @ pb, pb.transpose(0, 2, 1) @ at
        quu[:, own_m, own_m] += price * damp + 1e-3
        qu = price * effort[r] + np.einsum("cji,cj->ci", bt, ahead)
        both = np.linalg.solve(quu, np.concatenate((qux, qu[:, :, None]), 2))
        feed, step = both[:, :, :n], both[:, :, n]
        out.feedback[r], out.forward[r] = -feed, -step
        new = at.transpose(0, 2, 1) @ (p_next @ at) - qux.transpose(0, 2, 1) @ feed
        new = 0.5 * (new + new.transpose(0, 2, 1))
        new[:, own_n, own_n] += state_price * damp
        slope[:here] = error[r] * state_price + np.einsum("cji,cj->ci", at, ahead)
        slope[:here] -= np.einsum("cji,cj->ci", qux, step)
        value[:here] = new
        out.value[r], out.slope[r] = value[:here], slope[:here]
    return out
