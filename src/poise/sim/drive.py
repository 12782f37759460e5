"""The Drive: the one place where everything that moves a character adds its share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.errors import PoiseError


@dataclass(frozen=True, eq=False)
class Drive:
    """What is applied to every world during the next physics steps.

    PD targets, residual forces, pushes and a partner's hand all *add* to these tensors, so
    they combine freely. `clear()` comes at the start of a control step; the values are then
    held over its physics steps. On the CPU the tensors are views of the simulator's own state.

    Attributes:
        ctrl: `(N, nu)`, actuator inputs (rad for a position actuator on a hinge, N or Nm for a motor).
        qfrc_applied: `(N, nv)`, generalized force in joint coordinates (Nm for a hinge). A free joint's
            six numbers are the force (N, world axes, acting at the body's origin `xpos`) and then the
            torque (Nm, in the BODY's axes), since MuJoCo's free-joint angular velocity is in the body's
            axes.
        xfrc_applied: `(N, nbody, 6)`, force (N, world axes, acting at the body's inertial centre
            `xipos`), then torque (Nm, world axes).
    """

    ctrl: Tensor
    qfrc_applied: Tensor
    xfrc_applied: Tensor

    def __post_init__(self) -> None:
        if torch.jit.is_tracing():
            # While operations are recorded for any number of worlds, sizes are no plain numbers.
            return
        n = self.ctrl.shape[0]
        shapes = tuple(self.ctrl.shape), tuple(self.qfrc_applied.shape), tuple(self.xfrc_applied.shape)
        if [len(s) for s in shapes] != [2, 2, 3] or shapes[2][2] != 6 or {s[0] for s in shapes} != {n}:
            raise PoiseError(
                "a Drive needs ctrl (N, nu), qfrc_applied (N, nv) and xfrc_applied (N, nbody, 6), got "
                f"{shapes[0]}, {shapes[1]} and {shapes[2]}",
                code="wrong-shape",
            )

    @classmethod
    def zeros(
        cls,
        num_envs: int,
        nu: int,
        nv: int,
        nbody: int,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> Drive:
        """A free-standing Drive of zeros, for tests and for backends that copy it in."""

        def zero(*shape: int) -> Tensor:
            return torch.zeros(num_envs, *shape, dtype=dtype, device=device)

        return cls(zero(nu), zero(nv), zero(nbody, 6))

    @property
    def num_envs(self) -> int:
        """The number of worlds N."""
        return self.ctrl.shape[0]

    def clear(self) -> None:
        """Set everything to zero, in place."""
        self.ctrl.zero_()
        self.qfrc_applied.zero_()
        self.xfrc_applied.zero_()

    def add_wrench_at(
        self,
        body: int | Sequence[int] | Tensor,
        point_w: Tensor,
        force_w: Tensor,
        torque_w: Tensor | None = None,
        *,
        xipos: Tensor,
    ) -> None:
        """Add a force that acts at a world point of a body, moved to the inertial centre.

        tau = torque_w + (point_w - xipos[body]) x force_w

        Args:
            body: one body index, with `(N, 3)` arguments; or K indices, shape `(K,)` or, a
                different choice per world, `(N, K)`, with `(N, K, 3)` arguments. The same
                body may occur several times.
            point_w: m, where the force acts.
            force_w: N, world axes.
            torque_w: Nm, world axes, a free moment beside the force.
            xipos: `(N, nbody, 3)` m, the inertial centres (the state field of that name).
        """
        like = self.xfrc_applied
        point, force = point_w.to(like), force_w.to(like)
        if isinstance(body, int):
            arm = point - xipos[:, body].to(like)
            torque = torch.linalg.cross(arm, force)
            like[:, body, :3].add_(force)
            like[:, body, 3:].add_(torque if torque_w is None else torque + torque_w.to(like))
            return
        index = torch.as_tensor(body, dtype=torch.long, device=like.device)
        index = index.expand(self.num_envs, index.shape[-1])[..., None]
        arm = point - xipos.to(like).gather(1, index.expand(-1, -1, 3))
        torque = torch.linalg.cross(arm, force.expand_as(arm))
        if torque_w is not None:
            torque = torque + torque_w.to(like)
        wrench = torch.cat([force.expand_as(arm), torque], -1)
        like.scatter_add_(1, index.expand(-1, -1, 6), wrench)
