"""Joint targets for the position actuators, and the paper's stable PD as a reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from poise.settings import Checked
from poise.sim.drive import Drive


@dataclass(frozen=True)
class PDTargets(Checked):
    """Actions become target angles `u` of the PD servos (RFC Eq. 1).

    Attributes:
        mode: "additive" u = q_ref + scale * a (RFC Sec. 5, the reference of the NEXT frame); "absolute"
            u = offset + scale * a (RFC Sec. 3).
        scale: rad per unit of action, one for all hinges or `(n)`, see `range_scale`.
        offset: `(n)` rad, used by "absolute" only (zeros if None, as in PHC).
        interpolate: targets go evenly from the last ones to the new ones over the physics steps of a
            control step, u_k = u_before + (k / K) (u - u_before), k = 1 ... K (a first-order hold);
            without, the new ones act at once (a zero-order hold).
    """

    mode: Literal["additive", "absolute"] = "additive"
    scale: float | Tensor = 1.0
    offset: Tensor | None = None
    interpolate: bool = False

    def apply(self, action: Tensor, q_ref_next: Tensor, drive: Drive) -> None:
        """Add the targets for `action (N, n)` to `drive.ctrl`."""
        drive.ctrl.add_(self.target(action, q_ref_next))

    def target(self, action: Tensor, q_ref_next: Tensor) -> Tensor:
        """The targets `(N, n)` rad of `action (N, n)`."""
        base, scale = self._terms(q_ref_next)
        plain = not isinstance(scale, Tensor) and scale == 1.0
        target = action if plain else action * scale
        return target if base is None else target + base

    def action(self, target: Tensor, q_ref_next: Tensor) -> Tensor:
        """The actions `(N, n)` that give the targets `target (N, n)` rad: the inverse of `target`."""
        base, scale = self._terms(q_ref_next)
        return (target if base is None else target - base) / scale

    def _terms(self, q_ref_next: Tensor) -> tuple[Tensor | None, float | Tensor]:
        """Base and scale, where the reference is."""
        base = q_ref_next if self.mode == "additive" else self.offset
        scale = self.scale.to(q_ref_next) if isinstance(self.scale, Tensor) else self.scale
        return None if base is None else base.to(q_ref_next.device), scale


def range_scale(ranges: Tensor) -> Tensor:
    """Rad per unit of absolute action, `(n)` of joint ranges `(n, 2)` rad: min(1.2 max |limit|, pi).

    PHC's code has it so, with a policy of unbounded actions; its knees have 5.
    """
    return (1.2 * ranges.abs().amax(-1)).clamp_max(torch.pi)


def stable_pd_torque(
    mass: Tensor,
    bias: Tensor,
    kp: Tensor,
    kd: Tensor,
    q: Tensor,
    qvel: Tensor,
    target: Tensor,
    dt: float,
    limit: Tensor,
) -> Tensor:
    """Torques `(..., n)` of a stable PD controller (Tan et al. 2011), as in the paper at 450 Hz.

        tau = -Kp (q + dt q' - u) - Kd (q' + dt q'')
        (M + Kd dt) q'' = -C - Kp (q + dt q' - u) - Kd q'

    Args:
        mass: `(..., nv, nv)` joint-space inertia M with a six-dimensional root first.
        bias: `(..., nv)` Coriolis, centrifugal and gravity forces C.
        kp, kd: `(n)` gains.
        q: `(..., n)` hinge angles.
        qvel: `(..., nv)`.
        target: `(..., n)` rad.
        dt: physics step in s.
        limit: `(n)` N m, torques are clipped after the implicit solve.
    """
    n, nv = kp.shape[-1], qvel.shape[-1]
    zeros = qvel.new_zeros(*qvel.shape[:-1], nv - n)
    p = torch.cat((zeros, kp * (q + dt * qvel[..., nv - n :] - target)), -1)
    d = torch.cat((qvel.new_zeros(nv - n), kd.expand(n)), -1)
    acc = torch.linalg.solve(mass + torch.diag(d * dt), -bias - p - d * qvel)
    tau = -p - d * (qvel + dt * acc)
    return torch.maximum(torch.minimum(tau[..., nv - n :], limit), -limit)
