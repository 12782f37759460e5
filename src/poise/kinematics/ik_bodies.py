"""A humanoid as inverse kinematics sees it, and the plane in which a limb bends."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from poise.body import BodyTable, Humanoid, find_anatomy
from poise.kinematics.coords import best_path, wrapped
from poise.kinematics.forward import Kinematics
from poise.motion import Skeleton
from poise.motion.rotations import across, normalize, quat_to_matrix, rejected, shortest_arc
from poise.motion.vectors import cross, norm


def square_to(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The part of `a (..., 3)` square to unit `b`; some vector across b where nothing remains."""
    rest = rejected(a, b)
    lost = norm(rest, keepdims=True) < 1e-9 * (norm(a, keepdims=True) + 1e-300)
    return np.where(lost, across(b), rest)


def frame_of(
    hold: str, x: np.ndarray | None = None, y: np.ndarray | None = None, z: np.ndarray | None = None
) -> np.ndarray:
    """Orthonormal `(..., 3, 3)` of two directions; axis `hold` is kept, the other made square to it."""
    given = {"x": x, "y": y, "z": z}
    kept = given.pop(hold)
    name, other = next((k, v) for k, v in given.items() if v is not None)
    assert kept is not None
    kept = normalize(kept)
    axes = {hold: kept, name: normalize(square_to(other, kept))}
    # The third axis closes the cycle x, y, z.
    last = next(k for k in "xyz" if k not in axes)
    at = "xyz".index(last)
    axes[last] = cross(axes["xyz"[(at + 1) % 3]], axes["xyz"[(at + 2) % 3]])
    return np.stack((axes["x"], axes["y"], axes["z"]), -1)


def rotate(m: np.ndarray, v: np.ndarray) -> np.ndarray:
    """m v `(..., 3)`."""
    return (m @ v[..., None])[..., 0]


def arc(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Matrices `(..., 3, 3)` of the smallest turn that brings `a (..., 3)` onto `b`."""
    return quat_to_matrix(shortest_arc(a, b))


def prefix_product(m: np.ndarray) -> np.ndarray:
    """m_t ... m_1 m_0 for every t `(T, ..., 3, 3)` in log2(T) passes (Hillis and Steele 1986)."""
    out, reach = m.copy(), 1
    while reach < len(out):
        out = np.concatenate((out[:reach], out[reach:] @ out[:-reach]))
        reach *= 2
    return out


def bend_normals(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    """u x v made unit length: Eqs. 5, 10 and 13 (up to sign), undefined for a straight limb."""
    return normalize(cross(upper, lower))


def held_normals(
    upper: np.ndarray,
    lower: np.ndarray,
    parent: np.ndarray,
    rest_upper: np.ndarray,
    rest_normal: np.ndarray,
    straight: float,
    reach: float,
) -> np.ndarray:
    """Unit bend axes `(T, L, 3)`, world, that never jump where a limb is straight.

    The angle theta of the observed axis about the upper bone is stated against an axis that is carried
    along with the bone without turning about it. A frame is trusted by c = s^4 / (s^4 + s_0^4), s the
    sine of its bend and s_0 of `straight`; what c lacks comes from the frames around it, so that what a
    bent limb shows holds through the frames where it is straight. Angles are averaged doubled, since a
    limb that is stretched beyond straight shows the same plane. Which side is forward is then the
    smoothest choice, where bends to the wrong side cost.

    Args:
        upper, lower: `(T, L, 3)` unit bones, world. parent: `(T, L, 3, 3)` what the upper bone hangs on.
        rest_upper, rest_normal: `(L, 3)` the bone and its bend axis at rest, in the parent.
        straight: rad, the bend at which the frames around count as much as the frame itself.
        reach: frames over which they do.
    """
    into = parent.mT
    u, v = rotate(into, upper), rotate(into, lower)
    carried = _carried(u, rest_normal)
    other, normal = cross(u, carried), cross(u, v)
    sine = norm(normal)

    def angle(n: np.ndarray) -> np.ndarray:
        return np.arctan2((n * other).sum(-1), (n * carried).sum(-1))

    theta = angle(normal)
    weight = sine**4 / (sine**4 + np.sin(straight) ** 4)
    # The way of least turning from the rest pose; it is lost where the bone points the other way.
    home = rotate(arc(np.broadcast_to(rest_upper, u.shape), u), np.broadcast_to(rest_normal, u.shape))
    trust = (0.5 + 0.5 * (rest_upper * u).sum(-1)) ** 2
    line = 0.5 * np.angle(_mean(theta, weight, angle(home), 1e-4 * trust, reach))
    both = np.stack((line, line + np.pi), -1)  # (T, L, 2)
    # The bend about each of the two axes: negative is to the wrong side.
    bend = np.arctan2(sine, (u * v).sum(-1))[..., None] * np.cos(theta[..., None] - both)
    step = wrapped(both[1:, :, None, :] - both[:-1, :, :, None])
    astray = wrapped(both - angle(home)[..., None])
    pull = np.square(np.minimum(bend, 0.0)) + 1e-4 * trust[..., None] * astray**2
    pick = best_path(step**2, pull)
    turn = np.take_along_axis(both, pick[..., None], -1)
    return rotate(parent, np.cos(turn) * carried + np.sin(turn) * other)


def _carried(u: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Unit vectors `(T, L, 3)` square to `u (T, L, 3)` that never turn about it from frame to frame."""
    none = np.broadcast_to(np.eye(3, dtype=u.dtype), (1, *u.shape[1:], 3))
    begin = square_to(start, u[0])
    begin = np.where(norm(begin, keepdims=True) < 0.05, across(u[0]), normalize(begin))
    turns = prefix_product(np.concatenate((none, arc(u[:-1], u[1:]))))
    return normalize(square_to(rotate(turns, np.broadcast_to(begin, u.shape)), u))


def _mean(
    theta: np.ndarray, weight: np.ndarray, home: np.ndarray, trust: np.ndarray, reach: float
) -> np.ndarray:
    """Sums of exp(2 i theta) `(T, L)`: a frame's own by its weight, the rest from those around it.

    Around a frame, others count by their weight and exp(-|dt| / reach), and `home` by `trust`.
    """
    own = np.exp(2j * theta)
    frames = len(own)
    kernel = np.exp(-np.arange(frames) / reach)
    both = np.fft.fft(np.concatenate((kernel, [0.0], kernel[:0:-1])))[:, None]

    def spread(x: np.ndarray) -> np.ndarray:
        return np.fft.ifft(np.fft.fft(x, 2 * frames, axis=0) * both, axis=0)[:frames]

    around = spread(weight * own) + trust * np.exp(2j * home)
    total = np.real(spread(weight)) + trust + 1e-12
    return weight * own + (1 - weight) * around / total


#: An elbow or knee that is bent less than this (rad) at rest does not tell the plane it bends in.
REST_BEND = math.radians(10.0)


@dataclass(frozen=True)
class Arm:
    """Rows of one arm or leg: upper and lower bone; `end` is the point (wrist or ankle) below them."""

    upper: int
    lower: int
    end: int
    leg: bool
    left: bool


@dataclass(frozen=True, eq=False)
class IkBody:
    """A humanoid as inverse kinematics sees it; made once by `of`.

    points: names of the positions that it reads: one per row of the table, then the toes.
    roles: point of each symbol of the paper (root, lhip, lk, lan, lf, lcl, ls, le, lw, ...).
    spine: rows from the mid spine up to the lower neck. arms: the four limbs. toes: point per foot row.
    heads: point above each neck row.
    rest_pos: `(P, 3)` m and rest_rot: `(R, 3, 3)`, the world at zero angles, root at the origin.
    links: `(R, 3, 3)`, rest rotation in the parent body. axes: `(R, 3, 3)`, the hinges' frame.
    clusters: points rigidly attached to a trunk row, the row's own first; see `_spanning`.
    normals: `(4, 3)`, the unit axis about which each of `arms` bends, in the rest pose, world.
    trunk: `(3, 3)`, columns left, up and forward in the rest pose.
    """

    table: BodyTable
    points: tuple[str, ...]
    roles: Mapping[str, int]
    spine: tuple[int, ...]
    arms: tuple[Arm, ...]
    toes: Mapping[int, int]
    heads: Mapping[int, int]
    rest_pos: np.ndarray
    rest_rot: np.ndarray
    links: np.ndarray
    axes: np.ndarray
    clusters: Mapping[int, tuple[int, ...]]
    normals: np.ndarray
    trunk: np.ndarray

    @property
    def chest(self) -> int:
        """The row that carries the shoulders: the last of the spine, the pelvis where there is none."""
        return self.spine[-1] if self.spine else 0

    @classmethod
    def of(cls, humanoid: Humanoid) -> IkBody:
        """The body of a humanoid that has two arms, two legs and a spine."""
        return ik_body(humanoid.table, humanoid.skeleton)


def ik_body(table: BodyTable, skeleton: Skeleton) -> IkBody:
    """See `IkBody`; `skeleton` tells where the toes are."""
    rows = table.rows
    zero = np.zeros((1, 7 + sum(len(r.order) for r in rows)))
    zero[:, 3] = 1.0
    rest = Kinematics(table)(zero)
    rest_rot = quat_to_matrix(rest.quat[0])
    places = [*rest.pos[0]]
    points = [r.name for r in rows]
    toes: dict[int, int] = {}
    by_joint = {r.joint: i for i, r in enumerate(rows)}
    for _, joint in find_anatomy(skeleton).toes:
        foot = by_joint.get(skeleton.parents[joint])
        if foot is not None and np.linalg.norm(skeleton.offsets[joint]) > 1e-4:
            toes[foot] = len(points)
            points.append(skeleton.names[joint])
            places.append(places[foot] + rest_rot[foot] @ skeleton.offsets[joint])
    rest_pos = np.stack(places)
    spine = tuple(i for i, r in enumerate(rows) if r.kind == "spine")
    roles = _roles(table, spine, toes)
    children: dict[int, list[int]] = {}
    for i, r in enumerate(rows):
        children.setdefault(r.parent, []).append(i)

    def attached(i: int) -> tuple[int, ...]:
        """Points that move rigidly with row i: its children, and theirs where they have no hinge."""
        out: list[int] = []
        todo = list(reversed(children.get(i, ())))
        while todo:
            out.append(todo.pop())
            todo += reversed(children.get(out[-1], ()) if not rows[out[-1]].order else ())
        return tuple(out)

    heads = {i: children[i][0] for i, r in enumerate(rows) if r.kind == "neck" and i in children}
    trunk = _trunk(rest_pos, roles)
    arms = _arms(table)
    axes = quat_to_matrix(np.array([r.frame for r in rows], dtype=float))
    normals = np.stack([_normal(table, a, rest_pos, rest_rot, axes, trunk) for a in arms])
    return IkBody(
        table=table,
        points=tuple(points),
        roles=roles,
        spine=spine,
        arms=arms,
        toes=toes,
        heads=heads,
        rest_pos=rest_pos,
        rest_rot=rest_rot,
        links=quat_to_matrix(np.array([r.quat for r in rows], dtype=float)),
        axes=axes,
        clusters={i: _spanning((i, *attached(i)), rest_pos, roles) for i in (0, *spine[-1:])},
        normals=normals,
        trunk=trunk,
    )


#: Points that lie within this share of the shoulders' distance of a line show no turn about it.
ON_A_LINE = 0.1


def _spanning(at: tuple[int, ...], rest: np.ndarray, roles: Mapping[str, int]) -> tuple[int, ...]:
    """The points of a cluster; with the shoulders where its own lie on a line, as those of a chest do
    whose collars hang on the neck."""
    off = rest[list(at)] - rest[at[0]]
    aside = float(np.linalg.svd(off, compute_uv=False)[1]) if len(at) > 2 else 0.0
    if aside > ON_A_LINE * float(norm(rest[roles["ls"]] - rest[roles["rs"]])):
        return at
    return (*at, *(roles[k] for k in ("ls", "rs") if roles[k] not in at))


def _roles(table: BodyTable, spine: tuple[int, ...], toes: Mapping[int, int]) -> dict[str, int]:
    """Points by the paper's symbols; a body without collarbones has its shoulders in their place."""
    short = {
        "clavicle": "cl",
        "upper_arm": "s",
        "forearm": "e",
        "hand": "w",
        "thigh": "hip",
        "shin": "k",
        "foot": "an",
    }
    out = {"root": 0, "mspine": (*spine, 0)[0], "lowneck": (0, *spine)[-1]}
    for i, r in enumerate(table.rows):
        if r.kind in short:
            out[r.side[0] + short[r.kind]] = i
            if r.kind == "foot" and i in toes:
                out[r.side[0] + "f"] = toes[i]
    for side in "lr":
        out.setdefault(f"{side}cl", out[f"{side}s"])
    return out


def _arms(table: BodyTable) -> tuple[Arm, ...]:
    def row(kind: str, side: str) -> int:
        return next(i for i, r in enumerate(table.rows) if (r.kind, r.side) == (kind, side))

    return tuple(
        Arm(*(row(kind, side) for kind in kinds), leg=leg, left=side == "left")
        for leg, kinds in (
            (False, ("upper_arm", "forearm", "hand")),
            (True, ("thigh", "shin", "foot")),
        )
        for side in ("left", "right")
    )


def _trunk(rest: np.ndarray, roles: Mapping[str, int]) -> np.ndarray:
    """Columns left, up and forward of a body at rest, from its hips and shoulders."""
    hips = rest[roles["lhip"]] + rest[roles["rhip"]]
    up = rest[roles["ls"]] + rest[roles["rs"]] - hips
    return frame_of("y", x=rest[roles["lhip"]] - rest[roles["rhip"]], y=up)


def _normal(
    table: BodyTable, arm: Arm, rest: np.ndarray, rot: np.ndarray, axes: np.ndarray, trunk: np.ndarray
) -> np.ndarray:
    """The axis about which an elbow or knee bends, in the rest pose.

    The hinge itself where there is one alone; else what the rest pose shows; where it is straight, that
    which lets a forearm bend forward and a shin backward.
    """
    upper = normalize(rest[arm.lower] - rest[arm.upper])
    lower = normalize(rest[arm.end] - rest[arm.lower])
    up, forward = trunk[:, 1], trunk[:, 2]
    towards = -forward if arm.leg else forward
    usual = cross(upper, towards)
    if float(norm(usual)) < 0.3:
        # The bone points that way itself: a seated thigh bends down, an arm held forward bends up.
        usual = cross(upper, -up if arm.leg else up)
    usual = normalize(usual)
    row = table.rows[arm.lower]
    if len(row.order) == 1:
        axis = rot[arm.lower] @ axes[arm.lower][:, "XYZ".index(row.order)]
        low, high = row.ranges[0]
        along = float(axis @ usual)
        # A range that lies on one side tells which way the joint bends; else the usual way does.
        towards_one_side = abs(low + high) > 0.5 * (high - low)
        sign = math.copysign(1.0, low + high if towards_one_side else along)
        return normalize(square_to(sign * axis, upper))
    bend = cross(upper, lower)
    angle = math.atan2(float(norm(bend)), float(upper @ lower))
    if angle > REST_BEND:
        return normalize(bend)
    if len(row.order) == 3:
        first, middle = (rot[arm.lower] @ axes[arm.lower][:, "XYZ".index(c)] for c in row.order[:2])
        if abs(float(middle @ usual)) > 0.7 and abs(float(first @ upper)) < 0.3:
            # A middle hinge would lock at 90 degrees. The first one bends the limb down, which in a
            # T-pose is what Eqs. 10 and 13 say.
            usual = first if float(first @ cross(upper, -up)) >= 0 else -first
    return normalize(square_to(usual, upper))
