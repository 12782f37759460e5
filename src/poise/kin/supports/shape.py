"""From parts that rest on a plane to the box that bears them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from poise.kin.supports.candidates import Candidate, Solid
from poise.kin.supports.room import SOFT_M, face, rectangle
from poise.kin.supports.support import Kind, Support

#: Half extents (m) about the points that rest: to the sides, and least of all.
AROUND: dict[Kind, float] = {"seat": 0.12, "step": 0.15, "table": 0.20, "wall": 0.35}
#: Thickness (m) where a support cannot reach down to the floor; of a wall.
BOARD_M, WALL_M = 0.05, 0.10
#: Least extent (m) of the face of a support.
LEAST_M = 0.10
#: Two supports with faces no farther from each other are one, m.
SAME_M = 0.05


def together(found: Sequence[tuple[Candidate, float]]) -> list[list[tuple[Candidate, float]]]:
    """Candidates on one plane and near to each other share a support."""
    groups: list[list[tuple[Candidate, float]]] = []
    for c, force in found:
        for group in groups:
            o = group[0][0]
            same = o.group.kind == c.group.kind and float(o.normal @ c.normal) > 0.9
            if same and abs(o.level - c.level) < SAME_M:
                group.append((c, force))
                break
        else:
            groups.append([(c, force)])
    return groups


def boxed(group: Sequence[tuple[Candidate, float]], solid: Solid) -> Support | None:
    """The box of candidates that share it; None where there is no room."""
    first = group[0][0]
    points = np.concatenate([solid.touching(c, t) for c, _ in group for t in range(c.start, c.stop + 1)])
    if not len(points):
        return None
    axes = face(first.normal, _yaw(first, solid))
    local = points @ axes.T
    level = float(np.median([c.level for c, _ in group]))
    centres = solid.centres.reshape(-1, 3) @ axes.T - np.array([0.0, 0.0, level])
    radii = np.tile(solid.radii, len(solid.centres))
    low, high = np.quantile(local[:, :2], 0.1, axis=0), np.quantile(local[:, :2], 0.9, axis=0)
    core, around = np.stack((low, high)), AROUND[first.group.kind]
    wanted = np.stack((low - around, high + around))
    wall = first.group.kind == "wall"
    if wall:
        wanted[:, 1] = 0.0, high[1] + around
        core[0, 1] = 0.0
    made, thick = None, WALL_M if wall else level
    # Where it cannot reach down to the floor, it is a board.
    for thick in (WALL_M,) if wall else (level, BOARD_M):
        made = rectangle(centres, radii, wanted, core, thick - (0.0 if wall else SOFT_M))
        if made is not None and (made[1] - made[0]).min() >= min(0.25, LEAST_M + around):
            break
    if made is None or (made[1] - made[0]).min() < LEAST_M:
        return None
    middle = np.array([*made.mean(0), level - thick / 2]) @ axes
    wide, far = (float(x) for x in made[1] - made[0])
    size = (wide, far, thick)
    yaw = math.atan2(axes[0, 1], axes[0, 0])
    if wall:
        # The face's v is the box's z, and its normal the box's -y.
        size = (wide, thick, far)
    rows = dict.fromkeys(i for c, _ in group for i in c.group.rows)
    names = [f"{r.side} {r.kind}".replace("_", " ").strip() for r in (solid.table.rows[i] for i in rows)]
    start, stop = min(c.start for c, _ in group), max(c.stop for c, _ in group)
    return Support(
        first.group.kind, size, (float(middle[0]), float(middle[1]), float(middle[2])), yaw,
        start / solid.fps, stop / solid.fps, tuple(dict.fromkeys(names)), max(f for _, f in group),
    )  # fmt: skip


def _yaw(c: Candidate, solid: Solid) -> float:
    """How an upward face is turned: a seat as the hips, anything else as the part that rests."""
    if c.group.kind == "seat" and len(c.group.rows) > 2:
        across = (
            solid.pos[c.start : c.stop + 1, c.group.rows[1]]
            - solid.pos[c.start : c.stop + 1, c.group.rows[2]]
        )
        return float(np.arctan2(*np.median(across[:, :2], 0)[::-1])) + math.pi / 2
    mine = solid.points(c.group.rows, c.normal, c.start)[:, :2]
    _, _, ways = np.linalg.svd(mine - mine.mean(0), full_matrices=False)
    return float(np.arctan2(ways[0, 1], ways[0, 0])) if len(mine) > 1 else 0.0
