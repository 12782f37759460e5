"""Places at which a character's geoms touch: lowest points, surface points of feet, centre of mass."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from itertools import product
from typing import Concatenate, NamedTuple, ParamSpec

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.motion.rotations import normalize, quat_mul, quat_rotate

PIECE = 4096
"""Frames in which geoms are placed at once."""
SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX = 2, 3, 4, 5, 6
"""Geom kinds by MuJoCo's `mjtGeom` numbers."""
KINDS = {"sphere": SPHERE, "capsule": CAPSULE, "ellipsoid": ELLIPSOID, "cylinder": CYLINDER, "box": BOX}


@dataclass(frozen=True, eq=False)
class Shapes:
    """The G collision geoms of a character, in MuJoCo's conventions.

    Attributes:
        kind: `(G,)` int, `mjtGeom`: sphere 2, capsule 3, ellipsoid 4, cylinder 5, box 6.
        size: `(G, 3)` m: radius; radius and half length along local Z (capsule, cylinder); half axes.
        pos: `(G, 3)` m, place of the geom in its body's frame.
        quat: `(G, 4)` wxyz, its rotation there.
        body: `(G,)` int, index of the geom's body along dim -2 of the body poses.
        mass: `(G,)` kg, or None for one density throughout.
    """

    kind: Tensor
    size: Tensor
    pos: Tensor
    quat: Tensor
    body: Tensor
    mass: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.kind)
        for name, width in dict(kind=(), size=(3,), pos=(3,), quat=(4,), body=(), mass=()).items():
            if (value := getattr(self, name)) is None:
                continue
            value = torch.as_tensor(value)
            if tuple(value.shape) != (count, *width):
                want, got = (count, *width), tuple(value.shape)
                raise PoiseError(
                    f"shapes.{name} must be {want} for {count} geoms, got {got}", code="wrong-shape"
                )
            object.__setattr__(self, name, value.long() if name in ("kind", "body") else value)
        known = (self.kind >= SPHERE) & (self.kind <= BOX)
        if count == 0 or not bool(known.all()):
            what = "no geom" if count == 0 else f"a geom of kind {int(self.kind[~known][0])}"
            raise PoiseError(f"shapes hold {what}", hint=f"Known kinds: {KINDS}", code="unknown-shape")

    def __len__(self) -> int:
        return len(self.kind)

    def of_bodies(self, bodies: Sequence[int]) -> Shapes:
        """The geoms that belong to `bodies`."""
        keep = torch.isin(self.body, torch.as_tensor(list(bodies), dtype=torch.long))
        if not bool(keep.any()):
            raise PoiseError(f"none of the bodies {list(bodies)} has a geom", code="no-shapes")
        mass = None if self.mass is None else self.mass[keep]
        parts = (a[keep] for a in (self.kind, self.size, self.pos, self.quat, self.body))
        return Shapes(*parts, mass=mass)


class _Placed(NamedTuple):
    """Geoms in the world, one dtype.

    Attributes:
        centre: `(..., G, 3)` m.
        body: `(..., G, 4)` wxyz, their bodies' rotations.
        own: `(G, 4)` wxyz, their own in their bodies.
        size: `(G, 3)` m.
    """

    centre: Tensor
    body: Tensor
    own: Tensor
    size: Tensor


def _placed(body_pos: Tensor, body_quat: Tensor, shapes: Shapes) -> _Placed:
    """The geoms where the bodies carry them."""
    if (*body_pos.shape[:-1], 4) != tuple(body_quat.shape) or body_pos.shape[-1] != 3:
        raise PoiseError(
            f"body poses must be (..., B, 3) and (..., B, 4), got {tuple(body_pos.shape)} "
            f"and {tuple(body_quat.shape)}",
            code="wrong-shape",
        )
    if int(shapes.body.max()) >= body_pos.shape[-2]:
        raise PoiseError(
            f"shapes name body {int(shapes.body.max())}, but the poses hold {body_pos.shape[-2]} bodies",
            code="index-outside",
        )
    pos, quat, size = (a.to(body_pos) for a in (shapes.pos, shapes.quat, shapes.size))
    # Unit quaternions keep every digit.
    off = (quat.norm(dim=-1, keepdim=True) - 1.0).abs() > 4 * torch.finfo(quat.dtype).eps
    quat = torch.where(off, normalize(quat), quat)
    owner = shapes.body.to(body_pos.device)
    p, q = body_pos[..., owner, :], body_quat[..., owner, :]
    return _Placed(p + quat_rotate(q, pos.expand_as(p)), q, quat, size)


P = ParamSpec("P")


def _in_pieces(
    of_poses: Callable[Concatenate[Tensor, Tensor, P], Tensor],
) -> Callable[Concatenate[Tensor, Tensor, P], Tensor]:
    """`of_poses(body_pos, body_quat, ...)`, `PIECE` frames at a time: what is made on the way would need
    some 30 kB a frame, gigabytes for an hour."""

    @wraps(of_poses)
    def pieces(body_pos: Tensor, body_quat: Tensor, *rest: P.args, **more: P.kwargs) -> Tensor:
        lead = body_pos.shape[:-2]
        if math.prod(lead) <= PIECE or body_quat.shape[:-2] != lead:
            return of_poses(body_pos, body_quat, *rest, **more)
        flat = (x.reshape(-1, *x.shape[-2:]).split(PIECE) for x in (body_pos, body_quat))
        out = torch.cat([of_poses(p, q, *rest, **more) for p, q in zip(*flat, strict=True)])
        return out.reshape(*lead, *out.shape[1:])

    return pieces


@_in_pieces
def geom_heights(body_pos: Tensor, body_quat: Tensor, shapes: Shapes) -> Tensor:
    """Lowest world z of every geom, m, exact; `(..., B, 3)` and `(..., B, 4)` give `(..., G)`.

    The support function of each solid in direction -z; `n` is the world's z in geom axes.
    """
    centre, body, own, size = _placed(body_pos, body_quat, shapes)
    axes = quat_rotate(own[:, None].expand(-1, 3, -1), torch.eye(3).to(size).expand(len(own), 3, 3))
    turn = body[..., None, :].expand(*body.shape[:-1], 3, 4)
    n = quat_rotate(turn, axes.expand(*turn.shape[:-1], 3))[..., 2].abs()
    r, half, z = size[:, 0], size[:, 1], centre[..., 2]
    # sphere r;  capsule h |n_z| + r;  ellipsoid sqrt(sum (s_i n_i)^2);
    # cylinder r sqrt(1 - n_z^2) + h |n_z|;  box sum s_i |n_i|
    x, y, w = (n * size).unbind(-1)
    low = torch.stack(
        (
            z - r,
            z - n[..., 2] * half - r,
            z - (size * n).square().sum(-1).sqrt(),
            z - (r * (1 - n[..., 2].square()).clamp_min(0).sqrt() + half * n[..., 2]),
            z - (x + y + w),
        ),
        -1,
    )
    kind = (shapes.kind.to(z.device) - SPHERE).expand_as(z)
    return low.gather(-1, kind.unsqueeze(-1)).squeeze(-1)


def lowest_points(body_pos: Tensor, body_quat: Tensor, shapes: Shapes) -> Tensor:
    """Lowest world z over all geoms per frame, m: `(..., B, 3)` and `(..., B, 4)` give `(...)`."""
    return geom_heights(body_pos, body_quat, shapes).amin(-1)


_CORNERS = tuple(product((-1.0, 1.0), repeat=3))
_AXES = (
    (1.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, -1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0),
)
_BALL = (*(tuple(c / math.sqrt(3) for c in corner) for corner in _CORNERS), *_AXES)
_RIM = tuple(
    (math.cos(a), math.sin(a), z) for a in (k * math.pi / 4 for k in range(8)) for z in (-1.0, 1.0)
)


def _surface(kind: int, size: Tensor) -> Tensor:
    """Material points `(P, 3)` on one geom's surface, in its own frame."""
    r, half = size[0], size[1]
    if kind == BOX:
        return size.new_tensor(_CORNERS) * size
    if kind == CYLINDER:
        return size.new_tensor(_RIM) * torch.stack((r, r, half))
    ball = size.new_tensor(_BALL)
    if kind == ELLIPSOID:
        return ball * size
    if kind == SPHERE:
        return ball * r
    ends = size.new_tensor(((0.0, 0.0, -1.0), (0.0, 0.0, 1.0))) * half
    return (ends[:, None] + ball * r).reshape(-1, 3)


@_in_pieces
def foot_points(body_pos: Tensor, body_quat: Tensor, shapes: Shapes, feet: Sequence[int]) -> Tensor:
    """World positions `(..., F, 3)` m of material points on the geoms of the foot bodies `feet`.

    A box gives its 8 corners, a cylinder 16 rim points, a sphere or ellipsoid 14 surface points, a
    capsule 14 on each end ball. The points ride on the body, so a foot that rolls without slipping
    has no speed where it touches.
    """
    owned = shapes.of_bodies(feet)
    centre, body, own, size = _placed(body_pos, body_quat, owned)
    quat = quat_mul(body, own.expand_as(body))
    points = []
    for g in range(len(owned)):
        local = _surface(int(owned.kind[g]), size[g])
        q = quat[..., g, None, :].expand(*quat.shape[:-2], len(local), 4)
        points.append(centre[..., g, None, :] + quat_rotate(q, local.expand(*q.shape[:-1], 3)))
    return torch.cat(points, -2)


@_in_pieces
def centre_of_mass(body_pos: Tensor, body_quat: Tensor, shapes: Shapes) -> Tensor:
    """Centre of mass `(..., 3)` m from the geoms' masses, or from their volumes (one density)."""
    centre, _, _, size = _placed(body_pos, body_quat, shapes)
    if shapes.mass is not None:
        weight = shapes.mass.to(size)
    else:
        a, b, c = size.unbind(-1)
        ball = 4.0 / 3.0 * math.pi
        volumes = torch.stack(
            (
                ball * a**3,
                ball * a**3 + 2 * math.pi * a**2 * b,
                ball * a * b * c,
                2 * math.pi * a**2 * b,
                8 * a * b * c,
            ),
            -1,
        )
        weight = volumes.gather(-1, (shapes.kind.to(size.device) - SPHERE).unsqueeze(-1)).squeeze(-1)
    return (centre * weight.unsqueeze(-1)).sum(-2) / weight.sum()
