"""The help audit: how much the residual wrench did for the character.

Norms are summed over bodies, not vectors: two opposite pushes on two bodies are help, not zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.metrics.masking import masked_mean, masked_quantile
from poise.spatial import GRAVITY


@dataclass(frozen=True, eq=False)
class HelpAudit:
    """Help over the valid frames; zero wrenches give exactly zero.

    Attributes:
        force_mean_n: N, mean over frames of `sum_m ||F_m||`.
        force_p95_n: N, its 95th percentile.
        torque_mean_nm: N m, mean over frames of `sum_m ||tau_m||`.
        torque_p95_nm: N m, its 95th percentile.
        work_j_per_s: J/s, mean over frames of `sum_m |F_m . v_m + tau_m . omega_m|`.
        share_of_body_weight: `force_mean_n / (m g)`.
        force_n: `(..., T)` N, per frame.
        torque_nm: `(..., T)` N m, per frame.
        power_w: `(..., T)` W, per frame.
    """

    force_mean_n: float
    force_p95_n: float
    torque_mean_nm: float
    torque_p95_nm: float
    work_j_per_s: float
    share_of_body_weight: float
    force_n: Tensor
    torque_nm: Tensor
    power_w: Tensor


def help_audit(
    force: Tensor,
    torque: Tensor,
    point_vel: Tensor,
    ang_vel: Tensor,
    mass: float,
    *,
    mask: Tensor | None = None,
) -> HelpAudit:
    """Audit the residual wrench of one body `(T, 3)` or of M bodies `(..., T, M, 3)`.

    Args:
        force, torque: N and N m, as applied (after clipping and the curriculum's scale).
        point_vel: m/s, velocity of the body at the point where the force acts.
        ang_vel: rad/s, the body's angular velocity. Force and velocity must share one frame, torque
            and angular velocity too (the world's, or the root's).
        mass: kg, the whole character.
        mask: `(..., T)` bool, valid frames.
    """
    parts = (force, torque, point_vel, ang_vel)
    if any(p.shape != force.shape for p in parts) or force.ndim < 2 or force.shape[-1] != 3:
        shapes = ", ".join(str(tuple(p.shape)) for p in parts)
        raise PoiseError(
            "force, torque, point_vel and ang_vel must share one shape, (T, 3) or (..., T, M, 3), "
            f"got {shapes}"
        )
    if not mass > 0:
        raise PoiseError(f"the character's mass must be above 0 kg, got {mass}")
    if force.ndim == 2:
        force, torque, point_vel, ang_vel = (p.unsqueeze(-2) for p in parts)
    force_n = force.norm(dim=-1).sum(-1)
    torque_nm = torque.norm(dim=-1).sum(-1)
    # P_m = F_m . v_m + tau_m . omega_m; the sign is dropped: braking is help as much as driving.
    power_w = ((force * point_vel).sum(-1) + (torque * ang_vel).sum(-1)).abs().sum(-1)
    if mask is None:
        mask = torch.ones_like(force_n, dtype=torch.bool)
    force_mean = float(masked_mean(force_n, mask))
    return HelpAudit(
        force_mean_n=force_mean,
        force_p95_n=float(masked_quantile(force_n, 0.95, mask)),
        torque_mean_nm=float(masked_mean(torque_nm, mask)),
        torque_p95_nm=float(masked_quantile(torque_nm, 0.95, mask)),
        work_j_per_s=float(masked_mean(power_w, mask)),
        share_of_body_weight=force_mean / (mass * GRAVITY),
        force_n=force_n,
        torque_nm=torque_nm,
        power_w=power_w,
    )
