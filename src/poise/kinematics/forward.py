"""Batched forward kinematics of a humanoid, and its solid shapes in world poses.

Poses are NumPy arrays or tensors.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from poise.body import BodyTable
from poise.metrics import KINDS, Shapes, geom_heights
from poise.metrics import centre_of_mass as geoms_centre
from poise.motion import Clip
from poise.motion.rotations import axis_angle_to_quat, quat_mul, quat_rotate
from poise.motion.vectors import Array, cross, like, namespace, side_by_side


class BodyState(NamedTuple):
    """World state of every body; rows as in the table.

    pos `(..., B, 3)` m, quat `(..., B, 4)` wxyz, linvel `(..., B, 3)` m/s of the body's origin,
    angvel `(..., B, 3)` rad/s; all in world axes.
    """

    pos: Any
    quat: Any
    linvel: Any
    angvel: Any


class Kinematics:
    """Forward kinematics of one `BodyTable` for any batch of coordinates."""

    def __init__(self, table: BodyTable, dtype: Literal["float64", "float32"] = "float64"):
        self.table, self.dtype = table, dtype
        self._rows: list[_Row] = []
        at = 0
        for row in table.rows:
            frame = np.asarray(row.frame, dtype=float)
            axes = [quat_rotate(frame, np.eye(3)["XYZ".index(letter)]) for letter in row.order]
            pos, quat = (np.asarray(x, dtype=float) for x in (row.pos, row.quat))
            self._rows.append(_Row(row.parent, pos, quat, tuple(axes), row.order, at))
            at += len(row.order)
        self.hinges = at
        #: Rows that have hinges, in order.
        self.hinged = tuple(i for i, r in enumerate(self._rows) if r.order)
        # Chains of one order of axes are computed together: where they stand, and their hinges, all
        # first ones, then all second ones and so on.
        self._groups: list[tuple[str, int, np.ndarray]] = []
        placed: list[int] = []
        for order in dict.fromkeys(self._rows[i].order for i in self.hinged):
            places = [k for k, i in enumerate(self.hinged) if self._rows[i].order == order]
            starts = [self._rows[self.hinged[k]].at for k in places]
            columns = [s + d for d in range(len(order)) for s in starts]
            self._groups.append((order, len(places), np.array(columns)))
            placed += places
        self._order = np.argsort(np.array(placed))
        self._made: dict[Any, tuple[list[_Row], list[tuple[str, int, Any]], Any]] = {}

    def _beside(self, qpos: Any) -> tuple[list[_Row], list[tuple[str, int, Any]], Any]:
        """Rows, groups and their order as arrays of the kind of `qpos`, made once for each."""
        key = (type(qpos), qpos.device)
        if key not in self._made:
            xp = namespace(qpos)
            rows = [
                row._replace(
                    pos=like(row.pos, qpos),
                    quat=like(row.quat, qpos),
                    axes=tuple(like(axis, qpos) for axis in row.axes),
                )
                for row in self._rows
            ]
            groups = [(order, n, xp.asarray(c, device=qpos.device)) for order, n, c in self._groups]
            self._made[key] = rows, groups, xp.asarray(self._order, device=qpos.device)
        return self._made[key]

    def __call__(self, qpos: Array, qvel: Array | None = None) -> BodyState:
        """World body states of `qpos (..., 7 + n)` and, where given, `qvel (..., 6 + n)`."""
        xp = namespace(qpos)
        kind = getattr(xp, self.dtype)
        qpos = xp.astype(qpos, kind, copy=False)
        batch = qpos.shape[:-1]
        zero = xp.zeros((*batch, 3), dtype=kind, device=qpos.device)
        vel: Any = None if qvel is None else xp.astype(qvel, kind, copy=False)
        pos: list[Any] = []
        quat: list[Any] = []
        lin: list[Any] = []
        ang: list[Any] = []
        for parent, offset, rest, axes, _, at in self._beside(qpos)[0]:
            if parent < 0:
                p, q = qpos[..., :3], qpos[..., 3:7]
                v = zero if vel is None else vel[..., :3]
                w = zero if vel is None else quat_rotate(q, vel[..., 3:6])
            else:
                arm = quat_rotate(quat[parent], offset)
                p = pos[parent] + arm
                v, w = lin[parent], ang[parent]
                if vel is not None:
                    v = v + cross(w, arm)
                q = quat_mul(quat[parent], rest)
                for i, axis in enumerate(axes):
                    if vel is not None:
                        # The hinge's axis is fixed in the frame before its own turn.
                        w = w + quat_rotate(q, axis) * vel[..., 6 + at + i, None]
                    q = quat_mul(q, axis_angle_to_quat(axis, qpos[..., 7 + at + i]))
            pos.append(p)
            quat.append(q)
            lin.append(v)
            ang.append(w)
        return BodyState(*(xp.stack(x, axis=-2) for x in (pos, quat, lin, ang)))

    def local_quats(self, qpos: Array) -> Array:
        """`(..., J, 4)` wxyz, the turn of every hinged body away from its rest orientation.

        Rows follow `hinged`. Conjugation by the hinges' fixed frame keeps relative angles, so the
        turns are stated in that frame.
        """
        xp = namespace(qpos)
        qpos = xp.astype(qpos, getattr(xp, self.dtype), copy=False)
        _, groups, order = self._beside(qpos)
        # Hinges come first, so that every pass runs over numbers that lie side by side.
        half = 0.5 * side_by_side(xp.moveaxis(qpos[..., 7:], -1, 0))
        cos, sin = xp.cos(half), xp.sin(half)
        turns = []
        for letters, count, columns in groups:
            of = (xp.take(x, columns, axis=0) for x in (cos, sin))
            turns.append(_chain(letters, *(x.reshape(len(letters), count, *x.shape[1:]) for x in of)))
        joints = xp.take(xp.concat(turns, axis=1), order, axis=1)
        return side_by_side(xp.moveaxis(joints, (0, 1), (-1, -2)))


class _Row(NamedTuple):
    """A body as `Kinematics` uses it: its place and rotation in its parent's frame, the axes of its
    hinges there, their letters, and the column of the first one."""

    parent: int
    pos: Any
    quat: Any
    axes: tuple[Any, ...]
    order: str
    at: int


def _chain(order: str, cos: Any, sin: Any) -> Any:
    """Quaternions `(4, J, ...)` of J hinge chains from the halved angles' `cos`, `sin (n, J, ...)`."""
    xp = namespace(cos)
    zero = xp.zeros_like(cos[0])
    turn = [cos[0], zero, zero, zero]
    turn[1 + "XYZ".index(order[0])] = sin[0]
    for i, letter in enumerate(order[1:], 1):
        c, s = cos[i], sin[i]
        w, u, v, t = (0, *(1 + ("XYZ".index(letter) + k) % 3 for k in range(3)))
        # (w, u, v, t) times (c, s) about u's axis; v and t are the axes that follow it cyclically.
        turn[w], turn[u] = turn[w] * c - turn[u] * s, turn[u] * c + turn[w] * s
        turn[v], turn[t] = turn[v] * c + turn[t] * s, turn[t] * c - turn[v] * s
    return xp.stack(turn)


def carried(pos: Array, quat: Array, point: Any) -> Array:
    """World places `(T, 3)` m of `point (3)` m, fixed to a body at `pos (T, 3)` m and `quat (T, 4)`."""
    return pos + quat_rotate(quat, like(point, pos))


def shapes_of(table: BodyTable) -> Shapes:
    """The geoms of a body table as the metrics take them; a body's mass is shared by its geoms."""
    geoms = [(i, g, r.mass / len(r.geoms)) for i, r in enumerate(table.rows) for g in r.geoms]
    return Shapes(
        kind=np.array([KINDS[g.kind] for _, g, _ in geoms]),
        size=np.array([(*g.size, 0.0, 0.0)[:3] for _, g, _ in geoms]),
        pos=np.array([g.pos for _, g, _ in geoms], dtype=float),
        quat=np.array([g.quat for _, g, _ in geoms], dtype=float),
        body=np.array([i for i, _, _ in geoms]),
        mass=np.array([m for _, _, m in geoms]),
    )


def poses_of(clip: Clip, table: BodyTable) -> tuple[np.ndarray, np.ndarray]:
    """World places `(T, B, 3)` m and rotations `(T, B, 4)` wxyz of a table's bodies in a clip."""
    joints = [r.joint for r in table.rows]
    pos, quat = (x[:, joints] for x in clip.world())
    return pos, quat


def low_and_com(table: BodyTable, pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lowest point's height `(T)` m and the centre of mass `(T, 3)` m, from world body poses."""
    return lowest_height(table, pos, quat).min(-1), centre_of_mass(table, pos, quat)


def lowest_height(table: BodyTable, pos: Array, quat: Array) -> Array:
    """`(..., B)` m, the lowest point of each body's shapes, from world body poses."""
    xp, heights = namespace(pos), geom_heights(pos, quat, shapes_of(table))
    ends = list(itertools.accumulate(len(r.geoms) for r in table.rows))
    parts = [heights[..., a:b] for a, b in itertools.pairwise([0, *ends])]
    return xp.stack([xp.min(h, axis=-1) for h in parts], axis=-1)


def centre_of_mass(table: BodyTable, pos: Array, quat: Array) -> Array:
    """`(..., 3)` m from world body poses; a body's mass sits in the middle of its shapes."""
    return geoms_centre(pos, quat, shapes_of(table))


def extreme_points(
    table: BodyTable, pos: np.ndarray, quat: np.ndarray, rows: Sequence[int] | None = None
) -> np.ndarray:
    """`(T, P, 3)` m, the ends and corners of all shapes, or those of `rows`, lowered by their radius."""
    of = list[int]()
    middles, ends = list[tuple[float, ...]](), list[tuple[float, ...]]()
    turns, radii = list[tuple[float, ...]](), list[float]()
    for i in range(len(table.rows)) if rows is None else rows:
        for geom in table.rows[i].geoms:
            size = geom.size
            own, radius = [(0.0, 0.0, 0.0)], size[0]
            if geom.kind == "capsule":
                own = [(0.0, 0.0, -size[1]), (0.0, 0.0, size[1])]
            elif geom.kind == "box":
                own, radius = list(itertools.product(*((-x, x) for x in size))), 0.0
            count = len(own)
            of += [i] * count
            middles += [geom.pos] * count
            turns += [geom.quat] * count
            ends += own
            radii += [radius] * count
    middle, turn, end = (np.array(x, dtype=float) for x in (middles, turns, ends))
    out = carried(pos[:, of], quat[:, of], carried(middle, turn, end))
    out[..., 2] -= np.array(radii)
    return out
