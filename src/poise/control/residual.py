"""Residual forces (Yuan and Kitani 2020): the help that a policy may ask for, and its schedule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple, Protocol

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.motion.rotations import heading_quat, quat_rotate
from poise.settings import Checked, Length, NotNegative, Range, Share, validate
from poise.sim.drive import Drive


class Wrench(NamedTuple):
    """What was applied. M bodies (one for the implicit form), world axes.

    Attributes:
        force: `(N, M, 3)` N.
        torque: `(N, M, 3)` N m.
        point: `(N, M, 3)` m, where the force acts.
        body: `M` rows of the humanoid's table.
    """

    force: Tensor
    torque: Tensor
    point: Tensor
    body: tuple[int, ...]


class Residual(Protocol):
    """A kind of residual force: it turns an action into forces on a `Drive` and reports what it applied.

    The limits bound norms: the sum over bodies of the force's norm never exceeds `limit_n`, that of the
    torque's never `limit_nm`; zero switches the help off. Without `capped`, as in the paper, the limits
    only scale the action, and nothing bounds the help.
    """

    @property
    def limit_n(self) -> float:
        """The most force in N, summed over bodies."""
        ...

    @property
    def limit_nm(self) -> float:
        """The most torque in N m, summed over bodies."""
        ...

    @property
    def capped(self) -> bool:
        """Whether the limits bound the help; else they only scale the action."""
        ...

    @property
    def dims(self) -> int:
        """Length of the residual action."""
        ...

    def apply(
        self,
        action: Tensor,
        xpos: Tensor,
        xquat: Tensor,
        xipos: Tensor,
        drive: Drive,
        scale: Tensor | float = 1.0,
    ) -> Wrench:
        """Add the residual forces of `action (N, dims)` to `drive`; body arrays are MuJoCo's.

        scale: multiplies the limits (what a `HelpSchedule` has left of them): 0-dimensional, or `(N,)`
        where each world has its own.
        """
        ...

    def regularizer(self, action: Tensor) -> Tensor:
        """r_reg `(N,)` of the unscaled action, in (0, 1]; 1 without help."""
        ...


def _of_worlds(scale: Tensor | float) -> Tensor | float:
    """A scale that multiplies vectors `(N, M, 3)`."""
    if isinstance(scale, Tensor) and scale.dim() == 1:
        return scale.reshape(-1, 1, 1)
    return scale


def _capped(vectors: Tensor) -> Tensor:
    """Vectors `(N, M, 3)` scaled down where the sum over M of their norms exceeds 1."""
    total = vectors.norm(dim=-1).sum(-1)
    return vectors / total.clamp_min(1.0)[:, None, None]


@dataclass(frozen=True)
class ImplicitResidual(Checked):
    """RFC-Implicit: a wrench on the root's six degrees of freedom (paper Eqs. 4 and 5).

    Action (6): force in the root's heading frame and torque in the root's own frame, in units of
    the limits; held over the control step.

    Attributes:
        limit_n: N.
        limit_nm: N m.
        k_r: weight in the regularizer exp(-k_r |a|^2).
        capped: whether the limits bound the help, or only scale the action.
    """

    limit_n: NotNegative = 100.0
    limit_nm: NotNegative = 100.0
    k_r: float = 1.0
    capped: bool = True

    @property
    def dims(self) -> int:
        """Six numbers: force, torque."""
        return 6

    def apply(
        self,
        action: Tensor,
        xpos: Tensor,
        xquat: Tensor,
        xipos: Tensor,
        drive: Drive,
        scale: Tensor | float = 1.0,
    ) -> Wrench:
        """Adds the root's generalized force eta_r; body row 0 is the root (MuJoCo body 1)."""
        root = xquat[:, 1].to(action.dtype)
        # Force and torque are one vector each, so that both are capped and turned together.
        unit = action.reshape(-1, 2, 3)
        local = unit / unit.norm(dim=-1, keepdim=True).clamp_min(1.0) if self.capped else unit
        local = local * local.new_tensor([[self.limit_n], [self.limit_nm]]) * _of_worlds(scale)
        force, torque = quat_rotate(torch.stack((heading_quat(root), root), 1), local).unbind(1)
        drive.qfrc_applied[:, 0:3].add_(force)
        drive.qfrc_applied[:, 3:6].add_(local[:, 1])
        return Wrench(force[:, None], torque[:, None], xpos[:, 1:2].to(action.dtype), (0,))

    def regularizer(self, action: Tensor) -> Tensor:
        """exp(-k_r |eta_r|^2) of the unscaled action (Eq. 5)."""
        return torch.exp(-self.k_r * action.square().sum(-1))


@dataclass(frozen=True)
class ExplicitResidual:
    """RFC-Explicit: a wrench at a learned contact point on each chosen body (Eqs. 2 and 3).

    Action (9 per body): contact point e (m), force and torque xi in units of the limits, all in the
    body's own frame.

    Attributes:
        bodies: rows of the humanoid's table.
        limit_n: N.
        limit_nm: N m.
        k_f: weight of the wrench in the regularizer.
        k_cp: weight of the contact point in the regularizer.
        reach_m: m, bound on |e|.
        capped: whether the limits bound the help and `reach_m` the points, or the limits only scale the
            action.
    """

    bodies: Annotated[tuple[int, ...], Length(1)] = (0,)
    limit_n: NotNegative = 100.0
    limit_nm: NotNegative = 100.0
    k_f: float = 1.0
    k_cp: float = 4.0
    reach_m: float = 0.3
    capped: bool = True

    def __post_init__(self) -> None:
        validate(self)
        if len(set(self.bodies)) != len(self.bodies):
            raise PoiseError(
                f"explicit residual forces need different bodies, got rows {self.bodies}",
                code="name-repeated",
            )

    @property
    def dims(self) -> int:
        """Nine numbers per body: point, force, torque."""
        return 9 * len(self.bodies)

    def apply(
        self,
        action: Tensor,
        xpos: Tensor,
        xquat: Tensor,
        xipos: Tensor,
        drive: Drive,
        scale: Tensor | float = 1.0,
    ) -> Wrench:
        """Adds sum_j J_ej^T xi_j, through MuJoCo's Cartesian applied forces."""
        index = [b + 1 for b in self.bodies]
        parts = action.reshape(-1, len(index), 3, 3)
        reach, *units = parts.unbind(2)
        if self.capped:
            reach = reach * (self.reach_m / reach.norm(dim=-1, keepdim=True).clamp_min(self.reach_m))
            units = [_capped(unit) for unit in units]
        quat = xquat[:, index].to(action.dtype)
        point = xpos[:, index].to(action.dtype) + quat_rotate(quat, reach)
        scale = _of_worlds(scale)
        force = quat_rotate(quat, units[0] * (self.limit_n * scale))
        torque = quat_rotate(quat, units[1] * (self.limit_nm * scale))
        drive.add_wrench_at(index, point, force, torque, xipos=xipos)
        return Wrench(force, torque, point, self.bodies)

    def regularizer(self, action: Tensor) -> Tensor:
        """exp(-sum_j (k_f |xi_j|^2 + k_cp |e_j|^2)) of the unscaled action (Eq. 3)."""
        parts = action.reshape(-1, len(self.bodies), 9).square()
        return torch.exp(
            -(self.k_f * parts[..., 3:].sum((-1, -2)) + self.k_cp * parts[..., :3].sum((-1, -2)))
        )


class HelpSchedule(Protocol):
    """When the help becomes less, and when more: a scale in [0, 1] multiplies a `Residual`'s limits."""

    @property
    def every(self) -> int:
        """Control steps between two decisions."""
        ...

    def scale(self, scale: float, steps: int, success: float) -> float:
        """The scale from now on.

        Args:
            scale: the present one.
            steps: control steps that each world has made.
            success: the share of recent episodes that did not end by failure, in [0, 1]; NaN when
                none has ended yet.
        """
        ...


@dataclass(frozen=True)
class LinearHelp:
    """Skeleton2Humanoid's Eq. 9: constant, then falling steadily, then constant.

    S_r = S_init - alpha (i - i_start) between i_start and i_end. The paper's iterations are control
    steps here; its S_init 220, alpha 0.1, i_start 100, i_end 1300 of 50,000 samples end at scale 0.45.

    Attributes:
        start: control steps of each environment at which the scale begins to fall.
        stop: control steps of each environment at which it has fallen.
        final: the scale at and after `stop`.
        every: control steps between two decisions.
    """

    start: Annotated[int, Range(0)]
    stop: int
    final: Share = 0.0
    every: int = 16

    def __post_init__(self) -> None:
        validate(self)
        if not self.start < self.stop:
            raise PoiseError(
                f"help must fall from one step to a later one, got {self.start}, {self.stop}",
                code="not-rising",
            )

    def scale(self, scale: float, steps: int, success: float) -> float:
        """A function of the steps alone."""
        along = min(1.0, max(0.0, (steps - self.start) / (self.stop - self.start)))
        return 1.0 - along * (1.0 - self.final)


@dataclass(frozen=True)
class SuccessHelp:
    """Less help while episodes succeed, more when they fail.

    Exploration fails many episodes that the policy itself would not: where the policy succeeds from
    97 % of the starts, training shows 0.65.

    Attributes:
        lower_at: success from which the scale is multiplied by `factor`.
        raise_at: success under which the scale is divided by it.
        factor: below 1.
        smallest: under this scale the help ends (it becomes `final`); a policy that then fails gets
            this much back.
        final: never less than this.
        every: control steps between two decisions.
    """

    lower_at: float = 0.5
    raise_at: float = 0.3
    factor: Annotated[float, Range(0, 1, above=True, below=True)] = 0.98
    smallest: Annotated[float, Range(0, 1, above=True)] = 0.05
    final: Share = 0.0
    every: int = 16

    def __post_init__(self) -> None:
        validate(self)
        if not 0 < self.raise_at < self.lower_at <= 1:
            raise PoiseError(
                f"success must satisfy 0 < raise_at {self.raise_at} < lower_at {self.lower_at} <= 1",
                code="not-rising",
            )

    def scale(self, scale: float, steps: int, success: float) -> float:
        """One notch down, up, or none."""
        if success >= self.lower_at:
            less = scale * self.factor
            return max(self.final, less if less >= self.smallest else 0.0)
        if success < self.raise_at:
            return min(1.0, max(scale, self.smallest) / self.factor)
        return scale
