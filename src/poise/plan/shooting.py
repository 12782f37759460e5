"""Rollouts of motions cut into shooting segments, each with every step size of a line search; the
best is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.plan.lqr import Regulator, driven
from poise.sim import CpuBackend, difference

#: rad that a target may be away from the reference; rad/s beyond which a world has gone bad.
REACH, WILD = 2.5, 200.0
#: What is paid for a state that is not finite, and for one that is lost.
AWFUL, LOST = 1e4, 1e9


@dataclass(eq=False)
class Segments:
    """Rows of some motions, one after another: their trajectory, which is changed, and what judges it.

    Attributes:
        qpos: `(F, nq)`, positions of the trajectory.
        qvel: `(F, nv)`, its velocities.
        action: `(F, nu + 6)`, its actions, see `lqr.linearise`.
        rest: `(F, nu + 6)`, actions of no effort.
        ahead: `(F, nu)` rad, hinge angles of the reference's next rows.
        ref_qpos: `(F, nq)`, positions of the reference.
        ref_qvel: `(F, nv)`, its velocities.
        share: `(F,)`, share of the help at each row.
        last: `(F,)` bool, whether the row ends a motion.
    """

    qpos: Tensor
    qvel: Tensor
    action: Tensor
    rest: Tensor
    ahead: Tensor
    ref_qpos: Tensor
    ref_qvel: Tensor
    share: np.ndarray
    last: np.ndarray


def segments(lengths: np.ndarray, size: int, shift: int) -> np.ndarray:
    """`(S, 2)` first row and end of segments of about `size` steps; the first of a motion has `shift`
    of them.

    The end of a segment is the row where the next begins, or the last of its motion.
    """
    out, at = [], 0
    for length in lengths.tolist():
        steps = length - 1
        cuts = [x for x in range(shift or size, steps - size // 4, size) if x >= size // 4]
        edges = [0, *cuts, steps]
        out += [(at + a, at + b) for a, b in pairwise(edges)]
        at += length
    return np.array(out)


@torch.no_grad()
def best_steps(
    model: mujoco.MjModel,
    path: Segments,
    gains: Regulator,
    cut: np.ndarray,
    steps: Sequence[float],
    lost: float,
    prices: tuple[np.ndarray, float],
    drive: tuple[Tensor, int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Rolls all segments `cut (S, 2)` out with all steps at once, and keeps the best of each in `path`.

    A rollout acts by u = u_path + step k + K d and pays what `regulate` minimises, with the value
    function for where it ends. A segment ends beside the next one's beginning: the gap is for the next
    iteration to close.

    Args:
        lost: error of the body, in units of what costs 1, from which on a rollout is no choice.
        prices: of the state `(2 nv)`, and of targets.
        drive: units of the wrench, physics steps, threads.

    Returns:
        `(S,)` the steps taken, and the mean costs of the states' errors.
    """
    (price, effort), (unit, substeps, threads) = prices, drive
    count, joints, nv = len(cut), model.nu, model.nv
    n = torch.from_numpy(cut[:, 1] - cut[:, 0]).repeat(len(steps))
    begin = torch.from_numpy(cut[:, 0]).repeat(len(steps))
    step = torch.tensor(steps, dtype=torch.float64).repeat_interleave(count)[:, None]
    feed, forward = torch.from_numpy(gains.feedback), torch.from_numpy(gains.forward).double()
    value, slope = torch.from_numpy(gains.value), torch.from_numpy(gains.slope)
    cost_of, share = torch.from_numpy(price), torch.from_numpy(path.share)
    total, worlds = int(n.max()), len(n)
    qs, vs = (path.qpos.new_empty(total + 1, worlds, x.shape[1]) for x in (path.qpos, path.qvel))
    us = path.action.new_empty(total, worlds, path.action.shape[1])
    paid, error = torch.zeros(2, worlds, dtype=torch.float64)
    gone = torch.zeros(worlds, dtype=torch.bool)
    backend = CpuBackend(model, worlds, threads)
    q, v = path.qpos[begin].clone(), path.qvel[begin].clone()
    for t in range(total + 1):
        row, on = begin + n.clamp_max(t), t < n
        qs[t], vs[t] = q, v
        off = torch.cat((difference(q, path.qpos[row]), v - path.qvel[row]), 1)
        wrong = torch.cat((difference(q, path.ref_qpos[row]), v - path.ref_qvel[row]), 1)
        wrong = (wrong.square() * cost_of).sum(1)
        gone |= ~((wrong / (2 * nv)).sqrt() < lost) & (t <= n)
        ends = (n == t).nonzero().squeeze(-1)
        if len(ends):
            d, r = off[ends].clamp(-10.0, 10.0).nan_to_num(10.0), row[ends]
            d32 = d.float()
            paid[ends] += torch.einsum("ni,nij,nj->n", d32, value[r], d32).double()
            paid[ends] += 2.0 * (slope[r] * d).sum(1)
        if t == total:
            break
        change = torch.einsum("nij,nj->ni", feed[row], off.float().nan_to_num(0.0)).double()
        act = path.action[row] + step * forward[row] + change
        near = path.ahead[row]
        targets = torch.minimum(torch.maximum(act[:, :joints], near - REACH), near + REACH)
        act = torch.cat((targets, act[:, joints:]), 1).nan_to_num(0.0)
        us[t] = act
        apart = act - path.rest[row]
        wrong = wrong.nan_to_num(AWFUL).clamp_max(AWFUL)
        price_t = wrong + effort * apart[:, :joints].square().sum(1)
        price_t += apart[:, joints:].square().sum(1) / share[row] ** 2
        paid += torch.where(on, price_t, 0.0)
        error += torch.where(on, wrong, 0.0)
        q, v = backend.successors(q, v, *driven(act, nv, unit), substeps)
        bad = ~(q.isfinite().all(1) & v.isfinite().all(1) & (v.abs().amax(1) < WILD))
        q[bad], v[bad] = path.ref_qpos[row[bad]], path.ref_qvel[row[bad]]
        gone |= bad & on
    backend.close()
    paid = paid.nan_to_num(1e12) + LOST * gone
    best = paid.view(len(steps), count).argmin(0)
    pick = best * count + torch.arange(count)
    for s, w in enumerate(pick.tolist()):
        a, b = cut[s]
        # The last row of a motion belongs to its last segment.
        end = b + int(path.last[b])
        path.qpos[a:end], path.qvel[a:end] = qs[: end - a, w], vs[: end - a, w]
        path.action[a:b] = us[: b - a, w]
    return np.array(steps)[best.numpy()], (error[pick] / n[pick]).numpy()
