"""The solid shapes of a body in world poses: its lowest points and its centre of mass."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable
from poise.kin.fk import carried
from poise.metrics import KINDS, Shapes, geom_heights
from poise.metrics import centre_of_mass as geoms_centre
from poise.motion import Clip


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
