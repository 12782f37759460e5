"""How large a support may be: no part of the motion passes through it."""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable
from poise.kin.fk import carried

#: Edge of the cells, m, in which room is sought.
CELL_M = 0.02
#: How deep a part may stand in what bears it, m: bodies are guessed, flesh and seats give way.
SOFT_M = 0.03
#: Balls along a capsule.
BALLS = 7


def balls(table: BodyTable, pos: Tensor, quat: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A body as balls: centres `(T, K, 3)` m in the world, radii `(K,)` m and their rows `(K,)`."""
    centres: list[Tensor] = []
    radii: list[float] = []
    rows: list[int] = []
    for i, row in enumerate(table.rows):
        for geom in row.geoms:
            size, turn = geom.size, torch.tensor(geom.quat, dtype=pos.dtype)
            local, radius = [(0.0, 0.0, 0.0)], size[0]
            if geom.kind == "capsule":
                local = [(0.0, 0.0, float(z)) for z in np.linspace(-size[1], size[1], BALLS)]
            elif geom.kind == "box":
                # Its surface is as far out as the half sizes.
                local, radius = list(itertools.product(*((-x, 0.0, x) for x in size))), 0.0
            for at in local:
                inner = carried(torch.tensor(geom.pos, dtype=pos.dtype), turn, at)
                centres.append(carried(pos[:, i], quat[:, i], inner))
                radii.append(radius)
                rows.append(i)
    return torch.stack(centres, 1).numpy(), np.array(radii), np.array(rows)


def rectangle(
    centres: np.ndarray, radii: np.ndarray, wanted: np.ndarray, core: np.ndarray, depth: float
) -> np.ndarray | None:
    """The largest rectangle about `core` within `wanted` below which nothing passes.

    The face that bears is the plane w = 0 and the support reaches to w = -depth; balls that come deeper
    than `SOFT_M` are in its way.

    Args:
        centres: `(M, 3)` m, balls in the frame (u, v, w) of the face. radii: `(M,)` m.
        wanted, core: `(2, 2)` m, least and greatest u, v.

    Returns:
        `(2, 2)` m like `wanted`; None where something passes through the middle of the core.
    """
    # How far a ball reaches to the side where it is inside.
    above = np.maximum(centres[:, 2] + SOFT_M, 0.0)
    below = np.maximum(-depth - centres[:, 2], 0.0)
    wide = np.square(radii) - np.square(np.maximum(above, below))
    near = (
        (centres[:, :2] + radii[:, None] > wanted[0]) & (centres[:, :2] - radii[:, None] < wanted[1])
    ).all(-1)
    at = (wide >= 0) & near
    count = np.maximum(np.ceil((wanted[1] - wanted[0]) / CELL_M).astype(int), 1)
    blocked = np.zeros(count, dtype=bool)
    balls_in = np.unique(
        np.round(np.c_[centres[at, :2], np.sqrt(wide[at])] / (CELL_M / 2)).astype(int), axis=0
    ) * (CELL_M / 2)
    mid = [wanted[0, k] + CELL_M * (np.arange(count[k]) + 0.5) for k in (0, 1)]
    for u, v, r in balls_in:
        blocked |= (mid[0] - u)[:, None] ** 2 + (mid[1] - v)[None] ** 2 <= (r + CELL_M / 2) ** 2
    low, high = (np.clip(((c - wanted[0]) / CELL_M).astype(int), 0, count - 1) for c in core)
    if blocked[low[0] : high[0] + 1, low[1] : high[1] + 1].any():
        low = high = (low + high) // 2
        if blocked[tuple(low)]:
            return None
    low, high = _grown(blocked, low, high)
    return np.stack((wanted[0] + CELL_M * low, wanted[0] + CELL_M * (high + 1)))


def _grown(blocked: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rectangle of free cells, grown a cell at a time on all sides where it can: along one axis
    first, along the other first, or along both by turns, whichever is largest."""
    made = [_grown_by(blocked, low, high, turns) for turns in (((0,), (1,)), ((1,), (0,)), ((0, 1),))]
    return max(made, key=lambda ends: int(np.prod(ends[1] - ends[0] + 1)))


def _grown_by(
    blocked: np.ndarray, low: np.ndarray, high: np.ndarray, turns: tuple[tuple[int, ...], ...]
) -> tuple[np.ndarray, np.ndarray]:
    """The rectangle grown along the axes of each turn as far as it goes."""
    low, high = low.copy(), high.copy()
    for axes in turns:
        grows = True
        while grows:
            grows = False
            for axis, way in itertools.product(axes, (-1, 1)):
                new = (low[axis] if way < 0 else high[axis]) + way
                if not 0 <= new < blocked.shape[axis]:
                    continue
                line = [slice(low[0], high[0] + 1), slice(low[1], high[1] + 1)]
                line[axis] = slice(new, new + 1)
                if blocked[tuple(line)].any():
                    continue
                grows = True
                (low if way < 0 else high)[axis] = new
    return low, high


def face(normal: np.ndarray, yaw: float) -> np.ndarray:
    """`(3, 3)`, rows the axes u, v, w of a face in the world: an upward one is turned by `yaw`, that of
    a wall has v upward."""
    if normal[2] > 0.9:
        c, s = math.cos(yaw), math.sin(yaw)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    up = np.array([0.0, 0.0, 1.0])
    return np.stack((np.cross(up, normal), up, normal))
