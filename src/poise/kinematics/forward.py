"""Batched forward kinematics of a humanoid in torch, and its solid shapes in world poses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable
from poise.metrics import KINDS, Shapes, geom_heights
from poise.metrics import centre_of_mass as geoms_centre
from poise.motion import Clip
from poise.motion.rotations import quat_mul, quat_rotate


class BodyState(NamedTuple):
    """World state of every body; rows as in the table.

    pos `(..., B, 3)` m, quat `(..., B, 4)` wxyz, linvel `(..., B, 3)` m/s of the body's origin,
    angvel `(..., B, 3)` rad/s; all in world axes.
    """

    pos: Tensor
    quat: Tensor
    linvel: Tensor
    angvel: Tensor


class Kinematics:
    """Forward kinematics of one `BodyTable` for any batch of coordinates."""

    def __init__(
        self,
        table: BodyTable,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ):
        self.table, self.dtype = table, dtype
        self._rows = []
        at = 0
        for row in table.rows:
            frame = torch.tensor(row.frame, dtype=dtype)
            axes = [
                quat_rotate(frame, torch.eye(3, dtype=dtype)["XYZ".index(letter)])
                for letter in row.order
            ]
            pos, quat = torch.tensor(row.pos, dtype=dtype), torch.tensor(row.quat, dtype=dtype)
            pos, quat, frame, *axes = (x.to(device) for x in (pos, quat, frame, *axes))
            self._rows.append((row.parent, pos, quat, frame, row.order, axes, at))
            at += len(row.order)
        self.hinges = at
        #: Rows that have hinges, in order.
        self.hinged = tuple(i for i, r in enumerate(self._rows) if r[4])
        # Chains of one order of axes are computed together: where they stand, and their hinges, all
        # first ones, then all second ones and so on.
        self._groups = []
        for order in dict.fromkeys(self._rows[i][4] for i in self.hinged):
            places = [k for k, i in enumerate(self.hinged) if self._rows[i][4] == order]
            starts = [self._rows[self.hinged[k]][6] for k in places]
            columns = [s + d for d in range(len(order)) for s in starts]
            self._groups.append((order, places, torch.tensor(columns).to(device)))
        placed = [k for _, places, _ in self._groups for k in places]
        self._order = torch.tensor(placed).argsort().to(device)

    def __call__(self, qpos: Tensor, qvel: Tensor | None = None) -> BodyState:
        """World body states of `qpos (..., 7 + n)` and, where given, `qvel (..., 6 + n)`."""
        qpos = qpos.to(self.dtype)
        batch = qpos.shape[:-1]
        zero = qpos.new_zeros(*batch, 3)
        vel = None if qvel is None else qvel.to(self.dtype)
        pos, quat, lin, ang = [], [], [], []
        for parent, offset, rest, _frame, _order, axes, at in self._rows:
            if parent < 0:
                p, q = qpos[..., :3], qpos[..., 3:7]
                v = zero if vel is None else vel[..., :3]
                w = zero if vel is None else quat_rotate(q, vel[..., 3:6])
            else:
                arm = quat_rotate(quat[parent], offset.expand(*batch, 3))
                p = pos[parent] + arm
                v, w = lin[parent], ang[parent]
                if vel is not None:
                    v = v + torch.linalg.cross(w, arm)
                q = quat_mul(quat[parent], rest.expand(*batch, 4))
                for i, axis in enumerate(axes):
                    angle = qpos[..., 7 + at + i]
                    if vel is not None:
                        # The hinge's axis is fixed in the frame before its own turn.
                        w = w + quat_rotate(q, axis.expand(*batch, 3)) * vel[..., 6 + at + i, None]
                    half = 0.5 * angle.unsqueeze(-1)
                    q = quat_mul(q, torch.cat((half.cos(), axis * half.sin()), -1))
            pos.append(p)
            quat.append(q)
            lin.append(v)
            ang.append(w)
        return BodyState(*(torch.stack(x, -2) for x in (pos, quat, lin, ang)))

    def local_quats(self, qpos: Tensor) -> Tensor:
        """`(..., J, 4)` wxyz, the turn of every hinged body away from its rest orientation.

        Rows follow `hinged`. Conjugation by the hinges' fixed frame keeps relative angles, so the
        turns are stated in that frame.
        """
        qpos = qpos.to(self.dtype)
        # Hinges come first, so that every pass runs over numbers that lie side by side.
        half = 0.5 * qpos[..., 7:].movedim(-1, 0).contiguous()
        cos, sin = half.cos(), half.sin()
        turns = []
        for order, places, columns in self._groups:
            of = (x.index_select(0, columns).unflatten(0, (-1, len(places))) for x in (cos, sin))
            turns.append(_chain(order, *of))
        joints = torch.cat(turns, 1).index_select(1, self._order)
        return joints.movedim((0, 1), (-1, -2)).contiguous()


def _chain(order: str, cos: Tensor, sin: Tensor) -> Tensor:
    """Quaternions `(4, J, ...)` of J hinge chains from the halved angles' `cos`, `sin (n, J, ...)`."""
    zero = torch.zeros_like(cos[0])
    turn = [cos[0], zero, zero, zero]
    turn[1 + "XYZ".index(order[0])] = sin[0]
    for i, letter in enumerate(order[1:], 1):
        c, s = cos[i], sin[i]
        w, u, v, t = (0, *(1 + ("XYZ".index(letter) + k) % 3 for k in range(3)))
        # (w, u, v, t) times (c, s) about u's axis; v and t are the axes that follow it cyclically.
        turn[w], turn[u] = turn[w] * c - turn[u] * s, turn[u] * c + turn[w] * s
        turn[v], turn[t] = turn[v] * c + turn[t] * s, turn[t] * c - turn[v] * s
    return torch.stack(turn)


def carried(pos: Tensor, quat: Tensor, point: Tensor | np.ndarray | Sequence[float]) -> Tensor:
    """World places `(T, 3)` m of `point (3)` m, fixed to a body at `pos (T, 3)` m and `quat (T, 4)`."""
    return pos + quat_rotate(quat, torch.as_tensor(point, dtype=pos.dtype).expand_as(pos))


def shapes_of(table: BodyTable, dtype: torch.dtype = torch.float64) -> Shapes:
    """The geoms of a body table as the metrics take them; a body's mass is shared by its geoms."""
    geoms = [(i, g, r.mass / len(r.geoms)) for i, r in enumerate(table.rows) for g in r.geoms]
    return Shapes(
        kind=torch.tensor([KINDS[g.kind] for _, g, _ in geoms]),
        size=torch.tensor([(*g.size, 0.0, 0.0)[:3] for _, g, _ in geoms], dtype=dtype),
        pos=torch.tensor([g.pos for _, g, _ in geoms], dtype=dtype),
        quat=torch.tensor([g.quat for _, g, _ in geoms], dtype=dtype),
        body=torch.tensor([i for i, _, _ in geoms]),
        mass=torch.tensor([m for _, _, m in geoms], dtype=dtype),
    )


def poses_of(clip: Clip, table: BodyTable) -> tuple[Tensor, Tensor]:
    """World places `(T, B, 3)` m and rotations `(T, B, 4)` wxyz of a table's bodies in a clip."""
    joints = [r.joint for r in table.rows]
    pos, quat = (torch.tensor(x[:, joints]) for x in clip.world())
    return pos, quat


def low_and_com(table: BodyTable, pos: Tensor, quat: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """The lowest point's height `(T)` m and the centre of mass `(T, 3)` m, from world body poses."""
    low = lowest_height(table, pos, quat).min(-1).values.numpy()
    return low, centre_of_mass(table, pos, quat).numpy()


def lowest_height(table: BodyTable, pos: Tensor, quat: Tensor) -> Tensor:
    """`(..., B)` m, the lowest point of each body's shapes, from world body poses."""
    heights = geom_heights(pos, quat, shapes_of(table)).split([len(r.geoms) for r in table.rows], -1)
    return torch.stack([h.amin(-1) for h in heights], -1)


def centre_of_mass(table: BodyTable, pos: Tensor, quat: Tensor) -> Tensor:
    """`(..., 3)` m from world body poses; a body's mass sits in the middle of its shapes."""
    return geoms_centre(pos, quat, shapes_of(table))


def extreme_points(
    table: BodyTable, pos: Tensor, quat: Tensor, rows: Sequence[int] | None = None
) -> Tensor:
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
    middle, turn, end = (torch.tensor(x, dtype=pos.dtype) for x in (middles, turns, ends))
    out = carried(pos[:, of], quat[:, of], carried(middle, turn, end))
    out[..., 2] -= torch.tensor(radii, dtype=pos.dtype)
    return out
