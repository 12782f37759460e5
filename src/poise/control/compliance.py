"""Giving way where something pushes: how forces displace a reference motion (Deep Compliant Control).

A character follows q^m, its reference, displaced by u: q = q^m + u. A force at a point with the Jacobian
J, at which the character moves by x against its reference, displaces it by

    u' = a J^T L x',    L = (J J^T)^-1                                              (Eq. 8)

with the level of compliance a. What PD servos of the stiffness Kp then show at that point, fixed at the
root and quasi-static, is (1 - a) K with K = (J Kp^-1 J^T)^-1; its determinant is (1 - a)^3 det K.
Algorithm 1 of the paper prints x' = h J dq'', one step's change of velocity: there u grows in proportion
to h, drifts under a constant force, and the stiffness is not (1 - a) K. Both are here.

**Joints.** The paper's joints are ball joints, and u is integrated by the quaternion exponential of
each. Here a joint is a chain of hinges, and u has a number for each hinge: the exponential of a turn
about a fixed axis adds angles, so that u' of a hinge is integrated by adding. The joint turns by exp(w
dt) with w = sum_i axis_i u'_i, the axes being where the chain stands: what a ball joint does that
follows the same u'. J has a column for each hinge, so that J u' = a x' holds for chains as for ball
joints.

**Points that cannot move in all directions** (few hinges, a stretched arm): L is the pseudo-inverse, in
which directions with an eigenvalue of J W J^T below `RANK` of the largest one count as none. What x' has
there moves nothing.

Coordinates are those of `qvel`: root m and rad, then hinges in rad. The root's rotation and its height
are never displaced, as in the paper (its y is our z).
"""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor

from poise.body import BodyTable
from poise.errors import PoiseError, did_you_mean
from poise.settings import Checked, NotNegative, Positive, Range

#: Share of the largest eigenvalue of J W J^T below which a direction counts as none.
RANK = 1e-4
#: The paper's time step, a constant of its Algorithm 1 at any physics rate, s.
PAPER_STEP_S = 1.0 / 600.0
#: Levels above which joints leave plausible ranges (Sec. 5.2).
PLAUSIBLE = 0.2

#: What a level can be, and a stiffness.
LEVEL = Range(
    0,
    1,
    hint="Above 1 it would run away from the force; 0.16 gives way as in the paper, above 0.2 joints "
    "become implausible",
)
STIFFNESS = Range(0, above=True, unit="N/m")
Level = Annotated[float, LEVEL]
NewtonsPerMetre = Annotated[float, STIFFNESS]

Law = Literal["eq8", "algorithm1"]
#: A part by its kind ("thigh") or its name ("lfemur"), and a number.
Parts = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Compliance(Checked):
    """How a motion gives way, by the paper.

    Attributes:
        level: a, 0 gives way to nothing; above 0.2 joints become implausible (`notes`), above 1 is an
            error. While a force would push hinges beyond their ranges it is lowered by itself (Sec.
            5.2).
        law: "eq8", x' is how fast the point moves against the reference; "algorithm1", x' is
            h J dq'' as printed, with the velocity that the force gives in one physics step.
        axes: share of the level along the world's X, Y and Z, 0 to 1 each.
        joints: share of the level of some parts, 0 to 1. The law K (1 - a) holds where all have one
            share.
        weights: of some parts' columns of J: more weight moves them more, and the others less. None
            changes what the point does.
        weighting: "inverse" is W J^T (J W J^T)^-1, which keeps the law; "printed" weights the columns of
            J itself, J W ((J W) (J W)^T)^-1, and does not.
        root: whether the root is displaced along the floor.
        return_hz: how fast u goes back to 0 where nothing acts: the undamped frequency of a critically
            damped spring; after 1 s at 1 Hz 1.4 % are left.
        least_n: N, weaker forces count as none.
        drawn: between which the level of each episode is drawn, evenly, for training; None: all have
            `level`.
    """

    level: Level = 0.16
    law: Law = "eq8"
    axes: Annotated[tuple[float, float, float], Range(0, 1)] = (1.0, 1.0, 1.0)
    joints: Annotated[Parts, Range(0, 1)] = ()
    weights: Annotated[Parts, Range(0, above=True)] = (("thigh", 2.0), ("upper_arm", 2.0))
    weighting: Literal["inverse", "printed"] = "inverse"
    root: bool = True
    return_hz: Positive = 1.0
    least_n: NotNegative = 1.0
    drawn: Annotated[tuple[float, float], LEVEL] | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """What should be known of these settings, in sentences."""
        if self.level <= PLAUSIBLE:
            return ()
        return (
            f"A level of compliance of {self.level:g} is above {PLAUSIBLE:g}, beyond which joints turn "
            "implausibly far.",
        )


@dataclass(frozen=True)
class Stiffness(Checked):
    """How a motion gives way by a stiffness that is commanded: an admittance on the goal.

    u goes to J^+ f (1 / K - c) with a lag, where c is how far the servos alone give way per newton along
    the force (`series`), so that both together are the commanded stiffness K.

    Attributes:
        newtons_per_metre: K, at the point of each force.
        lag_s: time constant.
        series: whether what the servos give way is taken off.
        hindsight: for training (hindsight perturbation, CHIP): what a policy is to reach stays where it
            is, and the goal that it sees lies where a spring of stiffness K would have to pull from,
            displaced by -J^+ f / K. What comes of it yields by K without being told a force.
        weights, root, return_hz, least_n: see `Compliance`; the root stands by default.
        schedule: other stiffnesses of an episode, `(control step, N/m)` in rising order: each from its
            step on.
    """

    newtons_per_metre: NewtonsPerMetre = 200.0
    lag_s: Positive = 0.1
    series: bool = True
    hindsight: bool = False
    weights: Annotated[Parts, Range(0, above=True)] = (("thigh", 2.0), ("upper_arm", 2.0))
    root: bool = False
    return_hz: Positive = 1.0
    least_n: NotNegative = 0.2
    schedule: Annotated[tuple[tuple[int, float], ...], STIFFNESS] = ()

    notes = ()


def columns(table: BodyTable, parts: Parts, root: bool) -> Tensor:
    """`(6 + n,)` a number for each column of J, 1 where `parts` has none; 0 for the root's height and
    turns, and for all of the root without `root`.

    Raises:
        PoiseError: no part of the body has such a kind or name.
    """
    known = dict(parts)
    names = {r.kind for r in table.rows} | {r.name for r in table.rows}
    # A body without a kind, such as one without clavicles, is no mistake; another word is.
    kinds = names | {k for k, _ in Compliance.weights}
    for name in known:
        if name not in kinds:
            raise PoiseError(
                f"no part of the body is called '{name}'",
                hint=did_you_mean(name, sorted(names)),
                code="unknown-body-part",
            )
    hinges = [known.get(r.name, known.get(r.kind, 1.0)) for r in table.rows for _ in r.hinge_names()]
    along = [1.0, 1.0] if root else [0.0, 0.0]
    return torch.tensor([*along, 0.0, 0.0, 0.0, 0.0, *hinges], dtype=torch.float64)


def moving(jacobian: Tensor, way: Tensor, weights: Tensor, weighting: str = "inverse") -> Tensor:
    """J^+ x `(..., nv)`: what moves points with the `jacobian (..., 3, nv)` by x, the `way (..., 3)`,
    with the columns' `weights (nv,)`.

    "inverse": J^+ = W J^T (J W J^T)^+, so that J J^+ is the identity where the point can move.
    "printed": A^T (A A^T)^+ with A = J W.
    """
    wide = jacobian * weights
    square = wide @ (jacobian if weighting == "inverse" else wide).transpose(-1, -2)
    return ((_inverse3(square) @ way.unsqueeze(-1)) * wide).sum(-2)


def _inverse3(square: Tensor) -> Tensor:
    """The pseudo-inverse of positive semidefinite `(..., 3, 3)`, see `RANK`."""
    a, b, c = square.unbind(-1)
    # The adjugate of a symmetric matrix: cross products of its columns.
    adjugate = torch.stack([torch.linalg.cross(x, y) for x, y in ((b, c), (c, a), (a, b))], -1)
    det = (a * adjugate[..., 0]).sum(-1)
    size = square.diagonal(dim1=-2, dim2=-1).sum(-1)
    # The least eigenvalue is at least det / size^2 and the largest one at most size.
    full = det > RANK * size**3
    out = adjugate / torch.where(full, det, 1.0)[..., None, None]
    if not bool(full.all()):
        out = torch.where(full[..., None, None], out, 0.0)
        rest = ~full & (size > 0.0)
        if bool(rest.any()):
            out[rest] = _by_eigenvalues(square[rest])
    return out


def _by_eigenvalues(square: Tensor) -> Tensor:
    values, axes = torch.linalg.eigh(square)
    real = values > RANK * values[..., -1:].clamp_min(torch.finfo(values.dtype).tiny)
    inverse = torch.where(real, 1.0 / values.clamp_min(torch.finfo(values.dtype).tiny), 0.0)
    return (axes * inverse.unsqueeze(-2)) @ axes.transpose(-1, -2)


def compliant_rate(
    jacobian: Tensor, velocity: Tensor, level: Tensor, weights: Tensor, given: Compliance, shares: Tensor
) -> Tensor:
    """u' `(N, nv)` of K forces in each of N worlds, summed (Eq. 8).

    Args:
        jacobian: `(N, K, 3, nv)` of the points.
        velocity: `(N, K, 3)` m/s, x' of each; 0 for what does not act.
        level: `(N,)` a.
        weights: `(nv,)` of the columns, 0 for those that are left out.
        given: the law's settings.
        shares: `(nv,)` of the level, by joint.
    """
    axes = torch.tensor(given.axes).to(velocity)
    # u' = a J^T L x'
    turned = moving(jacobian, axes * velocity, weights, given.weighting)
    return level.unsqueeze(-1) * shares * turned.sum(1)


def printed_velocity(jacobian: Tensor, change: Tensor, step_s: float) -> Tensor:
    """x' = h J dq'' `(N, K, 3)` as Algorithm 1 prints it, with the paper's h.

    jacobian: `(N, K, 3, nv)`. change: `(N, K, nv)`, by how much each force changes `qvel` in one physics
    step of `step_s`: FD with it less FD without, times the step.
    """
    return (jacobian @ change.unsqueeze(-1)).squeeze(-1) * (PAPER_STEP_S / step_s)


def softening(jacobian: Tensor, force: Tensor, stiffness: Tensor, kp: Tensor, series: bool) -> Tensor:
    """By how much a goal is to move per newton `(N, K)`, m/N: 1 / K - c, at least 0.

    Args:
        jacobian: `(N, K, 3, nv)`. force: `(N, K, 3)` N. stiffness: `(N,)` N/m.
        kp: `(n,)` N m/rad of the hinges; c = d^T (J Kp^-1 J^T) d along the force's direction d.
    """
    wanted = 1.0 / stiffness.unsqueeze(-1)
    if not series:
        return wanted.expand(force.shape[:-1])
    direction = force / force.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    torque = (jacobian.transpose(-1, -2) @ direction.unsqueeze(-1)).squeeze(-1)[..., 6:]
    return (wanted - (torque.square() / kp).sum(-1)).clamp_min(0.0)


def settled(u: Tensor, rate: Tensor, frequency_hz: float, seconds: float) -> tuple[Tensor, Tensor]:
    """u and u' after so many seconds of a critically damped spring to 0, exact at any rate."""
    w = 2.0 * math.pi * frequency_hz
    fade = math.exp(-w * seconds)
    # u(t) = e^(-w t) (u_0 + (u'_0 + w u_0) t)
    slope = rate + w * u
    return fade * (u + slope * seconds), fade * (rate - w * slope * seconds)


def room(step: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """`(N,)` the largest share of `step (N, n)` that stays within `low` and `high` `(N, n)`, 0 to 1."""
    limit = torch.where(step > 0.0, high, low)
    share = torch.where(step == 0.0, 1.0, limit / torch.where(step == 0.0, 1.0, step))
    return share.amin(-1).clamp(0.0, 1.0)
