"""What could bear a body: still parts of it, with a plane that they rest on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from poise.body import BodyTable
from poise.kin.doctor.needs import STILL
from poise.kin.series import find_runs
from poise.kin.supports.room import balls
from poise.kin.supports.support import Kind

#: A part rests for so long at least, s, and moves about by so much at most, m.
LEAST_S, DRIFT_M = 0.3, 0.12
#: Points this near to the plane may touch it, m.
TOUCH_M = 0.05
#: A plane lower than this is the floor, m.
FLOOR_M = 0.08
#: A knee that bears is no higher above the plane, m.
KNEE_M = 0.12
#: A seated body's thighs rise toward the hips by no more than this share of their length.
STEEP = 0.7
#: What share of a thigh, from the hip on, sits.
AT_HIPS = 0.35
#: A hand that rests on something level is no higher above the pelvis, m.
HIGH_M = 0.2
#: A hand at a wall is so far in front of the pelvis, m.
REACH_M = 0.25
#: Directions of walls.
WALLS = 8


@dataclass(frozen=True, eq=False)
class Group:
    """Parts that rest together: rows of the table, the first tells whether they are still.

    bias: what a find counts; what people use more is taken before others.
    """

    kind: Kind
    rows: tuple[int, ...]
    bias: float


@dataclass(frozen=True, eq=False)
class Candidate:
    """Parts that rest on a plane in the frames `start` to `stop` (inclusive).

    normal: of the plane, toward the body. level: m, where it lies along the normal.
    """

    group: Group
    start: int
    stop: int
    normal: np.ndarray
    level: float


class Solid:
    """A body's balls through a motion, and which candidates it has.

    Attributes:
        centres, radii, rows: see `balls`.
        bears: `(K,)` which balls may rest on something.
    """

    def __init__(self, table: BodyTable, pos: Tensor, quat: Tensor, fps: float):
        self.table, self.fps, self.pos = table, fps, pos.numpy()
        self.centres, self.radii, self.rows = balls(table, pos, quat)
        # Of thighs, what is at the hips sits.
        away = np.linalg.norm(self.centres[0] - self.pos[0, self.rows], axis=-1)
        thigh = np.array([table.rows[i].kind == "thigh" for i in self.rows])
        far = np.array([away[self.rows == i].max() for i in self.rows])
        self.bears = ~thigh | (away <= AT_HIPS * far)
        self.speed = np.linalg.norm(np.gradient(self.pos, axis=0), axis=-1) * fps

    def groups(self) -> list[Group]:
        """What may rest, by the kinds of parts."""

        def rows(*kinds: str, side: str | None = None) -> tuple[int, ...]:
            return tuple(
                i
                for i, r in enumerate(self.table.rows)
                if r.kind in kinds and (side is None or r.side == side)
            )

        sides = sorted({r.side for r in self.table.rows if r.kind == "thigh"})
        out = [Group("seat", rows("pelvis", "thigh"), 1.0)]
        for side in sides:
            out += [
                Group("step", rows("foot", side=side), 1.0),
                Group("step", rows("shin", side=side), 0.8),
                Group("table", rows("hand", "forearm", side=side), 0.8),
                Group("wall", rows("hand", side=side), 0.75),
            ]
        out.append(Group("wall", rows("spine", "pelvis", "clavicle"), 0.65))
        return [g for g in out if g.rows]

    def points(self, rows: Sequence[int], normal: np.ndarray, at: int | slice) -> np.ndarray:
        """`(..., K, 3)` m, the points of rows farthest against a normal."""
        mine = np.isin(self.rows, rows) & self.bears
        return self.centres[at][..., mine, :] - self.radii[mine, None] * normal

    def touching(self, c: Candidate, frame: int) -> np.ndarray:
        """`(K, 3)` m, the candidate's points at its plane, brought onto it; none outside its frames."""
        if not c.start <= frame <= c.stop:
            return np.zeros((0, 3))
        points = self.points(c.group.rows, c.normal, frame)
        off = points @ c.normal - c.level
        return (points - off[:, None] * c.normal)[np.abs(off) < TOUCH_M]

    def floor(self, frame: int) -> np.ndarray:
        """`(K, 3)` m, points that stand on the floor."""
        points = self.points(range(len(self.table.rows)), np.array([0.0, 0.0, 1.0]), frame)
        return points[points[:, 2] < FLOOR_M] * np.array([1.0, 1.0, 0.0])

    def candidates(self, first: int, last: int) -> list[Candidate]:
        """All of them in a stretch of frames."""
        out: list[Candidate] = []
        for group in self.groups():
            still = self.speed[first : last + 1, group.rows[0]] < STILL
            for a, b in find_runs(still, round(0.1 * self.fps)):
                for start, stop in self._calm(group.rows[0], first + a, first + b):
                    out += self._planes(group, start, stop)
        return out

    def _calm(self, row: int, first: int, last: int) -> list[tuple[int, int]]:
        """A run in pieces in which the part stays where it is."""
        out, start = list[tuple[int, int]](), first
        while start <= last:
            away = np.linalg.norm(self.pos[start : last + 1, row] - self.pos[start, row], axis=-1)
            gone = np.flatnonzero(away > DRIFT_M)
            stop = start + int(gone[0]) - 1 if len(gone) else last
            if (stop - start + 1) / self.fps >= LEAST_S:
                out.append((start, stop))
            start = stop + 1
        return out

    def _planes(self, group: Group, start: int, stop: int) -> list[Candidate]:
        at, first = slice(start, stop + 1), group.rows[0]
        if group.kind != "wall":
            up = np.array([0.0, 0.0, 1.0])
            level = float(np.median(self.points(group.rows, up, at)[..., 2].min(-1)))
            bears = level >= FLOOR_M and self._posed(group, at, level)
            return [Candidate(group, start, stop, up, level)] if bears else []
        out: list[Candidate] = []
        for k in range(WALLS):
            angle = 2 * math.pi * k / WALLS
            normal = np.array([math.cos(angle), math.sin(angle), 0.0])
            if self.table.rows[first].kind == "hand":
                # It reaches out to the wall.
                reach = float(np.median((self.pos[at, 0] - self.pos[at, first]) @ normal))
                if reach < REACH_M:
                    continue
            points = self.points(group.rows, normal, at)
            out.append(
                Candidate(group, start, stop, normal, float(np.median((points @ normal).min(-1))))
            )
        return out

    def _posed(self, group: Group, at: slice, level: float) -> bool:
        """Whether parts are turned as those are that rest on something level."""
        first = group.rows[0]
        if self.table.rows[first].kind == "shin":
            return float(np.median(self.pos[at, first, 2])) - level <= KNEE_M
        if group.kind == "table":
            return float(np.median(self.pos[at, first, 2] - self.pos[at, 0, 2])) <= HIGH_M
        if group.kind != "seat":
            return True
        shins = [next(k for k, r in enumerate(self.table.rows) if r.parent == i) for i in group.rows[1:]]
        line = self.pos[at][:, group.rows[1:]] - self.pos[at][:, shins]
        return float(np.median((line[..., 2] / np.linalg.norm(line, axis=-1)).max(-1))) <= STEEP
