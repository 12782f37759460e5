"""Places at which a character's geoms touch: lowest points, surface points of feet, centre of mass."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from itertools import product
from typing import Any, Concatenate, NamedTuple, ParamSpec, cast

import numpy as np

from poise.errors import PoiseError
from poise.motion.rotations import normalize, quat_mul, quat_rotate
from poise.motion.vectors import Array, floored, like, namespace, norm

PIECE = 4096
"""Frames in which geoms are placed at once."""
SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX = 2, 3, 4, 5, 6
"""Geom kinds by MuJoCo's `mjtGeom` numbers."""
KINDS = {"sphere": SPHERE, "capsule": CAPSULE, "ellipsoid": ELLIPSOID, "cylinder": CYLINDER, "box": BOX}


@dataclass(frozen=True, eq=False)
class Shapes:
    """The G collision geoms of a character, in MuJoCo's conventions, as arrays or tensors; they are used
    with poses of either kind.

    Attributes:
        kind: `(G,)` int, `mjtGeom`: sphere 2, capsule 3, ellipsoid 4, cylinder 5, box 6.
        size: `(G, 3)` m: radius; radius and half length along local Z (capsule, cylinder); half axes.
        pos: `(G, 3)` m, place of the geom in its body's frame.
        quat: `(G, 4)` wxyz, its rotation there.
        body: `(G,)` int, index of the geom's body along dim -2 of the body poses.
        mass: `(G,)` kg, or None for one density throughout.
    """

    kind: Any
    size: Any
    pos: Any
    quat: Any
    body: Any
    mass: Any = None

    def __post_init__(self) -> None:
        count = len(self.kind)
        for name, width in dict(kind=(), size=(3,), pos=(3,), quat=(4,), body=(), mass=()).items():
            if (value := getattr(self, name)) is None:
                continue
            value = value if hasattr(value, "ndim") else np.asarray(value)
            if tuple(value.shape) != (count, *width):
                want, got = (count, *width), tuple(value.shape)
                raise PoiseError(
                    f"shapes.{name} must be {want} for {count} geoms, got {got}", code="wrong-shape"
                )
            if name in ("kind", "body"):
                xp = namespace(value)
                value = xp.astype(value, xp.int64)
            object.__setattr__(self, name, value)
        known = (self.kind >= SPHERE) & (self.kind <= BOX)
        if count == 0 or not bool(known.all()):
            what = "no geom" if count == 0 else f"a geom of kind {int(self.kind[~known][0])}"
            raise PoiseError(f"shapes hold {what}", hint=f"Known kinds: {KINDS}", code="unknown-shape")

    def __len__(self) -> int:
        return len(self.kind)

    def of_bodies(self, bodies: Sequence[int]) -> Shapes:
        """The geoms that belong to `bodies`."""
        made: dict[Any, Shapes] = self.__dict__.setdefault("_of", {})
        key = tuple(bodies)
        if key not in made:
            made[key] = self._of_bodies(key)
        return made[key]

    def _of_bodies(self, bodies: tuple[int, ...]) -> Shapes:
        keep = (self.body[:, None] == namespace(self.body).asarray(list(bodies))).any(-1)
        if not bool(keep.any()):
            raise PoiseError(f"none of the bodies {list(bodies)} has a geom", code="no-shapes")
        mass = None if self.mass is None else self.mass[keep]
        parts = (a[keep] for a in (self.kind, self.size, self.pos, self.quat, self.body))
        return Shapes(*parts, mass=mass)

    def beside(self, poses: Any) -> _Parts:
        """The geoms as arrays of the kind, dtype and device of `poses`, made once for each."""
        made: dict[Any, _Parts] = self.__dict__.setdefault("_made", {})
        key = (type(poses), poses.dtype, poses.device)
        if key not in made:
            xp = namespace(poses)
            pos, quat, size = (like(x, poses) for x in (self.pos, self.quat, self.size))
            # Unit quaternions keep every digit.
            off = abs(norm(quat, keepdims=True) - 1.0) > 4 * xp.finfo(quat.dtype).eps
            quat = xp.where(off, normalize(quat), quat)
            kind, body = (xp.asarray(x, device=poses.device) for x in (self.kind, self.body))
            mass = None if self.mass is None else like(self.mass, poses)
            made[key] = _Parts(kind, size, pos, quat, body, mass)
        return made[key]


class _Parts(NamedTuple):
    """The fields of `Shapes` as arrays of one kind, floats of one dtype."""

    kind: Any
    size: Any
    pos: Any
    quat: Any
    body: Any
    mass: Any


class _Placed(NamedTuple):
    """Geoms in the world, one dtype.

    Attributes:
        centre: `(..., G, 3)` m.
        body: `(..., G, 4)` wxyz, their bodies' rotations.
        own: `(G, 4)` wxyz, their own in their bodies.
        size: `(G, 3)` m.
    """

    centre: Any
    body: Any
    own: Any
    size: Any


def _placed(body_pos: Array, body_quat: Array, shapes: Shapes) -> _Placed:
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
    own = shapes.beside(body_pos)
    p, q = body_pos[..., own.body, :], body_quat[..., own.body, :]
    return _Placed(p + quat_rotate(q, own.pos), q, own.quat, own.size)


P = ParamSpec("P")


def _in_pieces(
    of_poses: Callable[Concatenate[Array, Array, P], Array],
) -> Callable[Concatenate[Array, Array, P], Array]:
    """`of_poses(body_pos, body_quat, ...)`, `PIECE` frames at a time: what is made on the way would need
    some 30 kB a frame, gigabytes for an hour."""

    @wraps(of_poses)
    def pieces(body_pos: Array, body_quat: Array, *rest: P.args, **more: P.kwargs) -> Array:
        lead = body_pos.shape[:-2]
        if math.prod(lead) <= PIECE or body_quat.shape[:-2] != lead:
            return of_poses(body_pos, body_quat, *rest, **more)
        pos, quat = (x.reshape(-1, *x.shape[-2:]) for x in (body_pos, body_quat))
        parts = [slice(at, at + PIECE) for at in range(0, len(pos), PIECE)]
        made = [of_poses(pos[k], quat[k], *rest, **more) for k in parts]
        out = namespace(body_pos).concat(made, axis=0)
        return out.reshape(*lead, *out.shape[1:])

    return pieces


@_in_pieces
def geom_heights(body_pos: Array, body_quat: Array, shapes: Shapes) -> Array:
    """Lowest world z of every geom, m, exact; `(..., B, 3)` and `(..., B, 4)` give `(..., G)`.

    The support function of each solid in direction -z; `n` is the world's z in geom axes.
    """
    centre, body, own, size = _placed(body_pos, body_quat, shapes)
    xp = namespace(centre)
    axes = quat_rotate(own[:, None], like(((1, 0, 0), (0, 1, 0), (0, 0, 1)), size))
    n = abs(quat_rotate(body[..., None, :], axes)[..., 2])
    r, half, z = size[:, 0], size[:, 1], centre[..., 2]
    # sphere r;  capsule h |n_z| + r;  ellipsoid sqrt(sum (s_i n_i)^2);
    # cylinder r sqrt(1 - n_z^2) + h |n_z|;  box sum s_i |n_i|
    sides, square = n * size, n[..., 2] * n[..., 2]
    low = xp.stack(
        (
            z - r,
            z - n[..., 2] * half - r,
            z - (sides * sides).sum(-1) ** 0.5,
            z - (r * floored(1 - square, 0.0) ** 0.5 + half * n[..., 2]),
            z - (sides[..., 0] + sides[..., 1] + sides[..., 2]),
        ),
        axis=-1,
    )
    kind = xp.broadcast_to((shapes.beside(body_pos).kind - SPHERE)[:, None], (*z.shape, 1))
    return xp.take_along_axis(low, kind, axis=-1)[..., 0]


def lowest_points(body_pos: Array, body_quat: Array, shapes: Shapes) -> Array:
    """Lowest world z over all geoms per frame, m: `(..., B, 3)` and `(..., B, 4)` give `(...)`."""
    return namespace(body_pos).min(geom_heights(body_pos, body_quat, shapes), axis=-1)


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


def _surface(kind: int, size: Array) -> Array:
    """Material points `(P, 3)` on one geom's surface, in its own frame."""
    r, half = size[0], size[1]
    if kind == BOX:
        return like(_CORNERS, size) * size
    if kind == CYLINDER:
        return like(_RIM, size) * namespace(size).stack((r, r, half))
    ball = like(_BALL, size)
    if kind == ELLIPSOID:
        return ball * size
    if kind == SPHERE:
        return cast("Any", ball * r)
    ends = like(((0.0, 0.0, -1.0), (0.0, 0.0, 1.0)), size) * half
    return cast("Any", (ends[:, None] + ball * r).reshape(-1, 3))


@_in_pieces
def foot_points(body_pos: Array, body_quat: Array, shapes: Shapes, feet: Sequence[int]) -> Array:
    """World positions `(..., F, 3)` m of material points on the geoms of the foot bodies `feet`.

    A box gives its 8 corners, a cylinder 16 rim points, a sphere or ellipsoid 14 surface points, a
    capsule 14 on each end ball. The points ride on the body, so a foot that rolls without slipping
    has no speed where it touches.
    """
    owned = shapes.of_bodies(feet)
    centre, body, own, size = _placed(body_pos, body_quat, owned)
    quat = quat_mul(body, own)
    points = []
    for g in range(len(owned)):
        local = _surface(int(owned.kind[g]), size[g])
        points.append(centre[..., g, None, :] + quat_rotate(quat[..., g, None, :], local))
    return namespace(body_pos).concat(points, axis=-2)


@_in_pieces
def centre_of_mass(body_pos: Array, body_quat: Array, shapes: Shapes) -> Array:
    """Centre of mass `(..., 3)` m from the geoms' masses, or from their volumes (one density)."""
    centre, _, _, size = _placed(body_pos, body_quat, shapes)
    if shapes.mass is not None:
        weight = shapes.beside(body_pos).mass
    else:
        xp, (a, b, c) = namespace(size), (size[:, k] for k in range(3))
        ball = 4.0 / 3.0 * math.pi
        volumes = xp.stack(
            (
                ball * a**3,
                ball * a**3 + 2 * math.pi * a**2 * b,
                ball * a * b * c,
                2 * math.pi * a**2 * b,
                8 * a * b * c,
            ),
            axis=-1,
        )
        kind = shapes.beside(body_pos).kind - SPHERE
        weight = xp.take_along_axis(volumes, kind[:, None], axis=-1)[..., 0]
    return (centre * weight[..., None]).sum(-2) / weight.sum()
