"""A motion's supports: boxes that still parts of a body could rest on, and how large they may be."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.kinematics.forward import carried
from poise.kinematics.repair.needs import STILL
from poise.motion.smoothing import find_runs

Kind = Literal["seat", "step", "table", "wall"]
Vector = tuple[float, float, float]

#: Least and greatest extent of a support along an axis, m, and how far from the origin it may stand.
LEAST_M, MOST_M, FAR_M = 0.01, 20.0, 1000.0


@dataclass(frozen=True)
class Support:
    """A box that bears a body.

    Attributes:
        kind: "seat" bears pelvis and thighs, "step" a foot or a knee, "table" a hand or a forearm from
            below, "wall" whatever leans on its side.
        size: m, full extents along its own axes.
        pos: m, its centre in the world.
        yaw: rad, turn about the world's Z.
        start_s, stop_s: s, when it bears.
        parts: bodies that rest on it.
        force_n: N, what it bears at most, by inverse dynamics; 0 where it was stated by hand.
    """

    kind: Kind
    size: Vector
    pos: Vector
    yaw: float = 0.0
    start_s: float = 0.0
    stop_s: float = math.inf
    parts: tuple[str, ...] = ()
    force_n: float = 0.0

    @property
    def top(self) -> float:
        """Height of its upper face, m."""
        return self.pos[2] + self.size[2] / 2

    @property
    def quat(self) -> tuple[float, float, float, float]:
        """wxyz, box to world."""
        return math.cos(self.yaw / 2), 0.0, 0.0, math.sin(self.yaw / 2)

    def sentence(self) -> str:
        """What it is, where it stands and what it bears."""
        x, y, _ = self.pos
        high = f"{self.top:.2f} m high"
        what = f"a wall at ({x:.2f}, {y:.2f}) m" if self.kind == "wall" else f"a {self.kind} {high}"
        at = "" if self.kind == "wall" else f" at ({x:.2f}, {y:.2f}) m"
        if not self.force_n:
            return f"There is {what}{at}, as was stated."
        *most, last = self.parts or ("the body",)
        parts = f"{', '.join(most)} and {last}" if most else last
        return (
            f"The motion rests on something from {self.start_s:.1f} to {self.stop_s:.1f} s: {what}{at} "
            f"was placed, which bears {parts} with up to {self.force_n:.0f} N."
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as `read_supports` takes them; a support without end has no `stop_s`."""
        out = asdict(self)
        return out if math.isfinite(self.stop_s) else {k: v for k, v in out.items() if k != "stop_s"}


def read_supports(path: Path) -> tuple[Support, ...]:
    """Supports in a JSON file: one object or a list of them, with the names of `Support`'s attributes;
    `size` and `pos` are needed.

    Raises:
        PoiseError: no such file, no JSON, an unknown name, or a number that makes no sense.
    """
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except OSError as problem:
        raise PoiseError(f"cannot be read: {problem.strerror}", path, code="file-unreadable") from None
    except (ValueError, RecursionError) as problem:
        raise PoiseError(f"is no JSON: {str(problem)[:80]}", path, code="bad-json") from None
    rows = held if isinstance(held, list) else [held]
    if not rows or len(rows) > 500:
        raise PoiseError(f"holds {len(rows)} supports; there can be 1 to 500", path, code="out-of-range")
    return tuple(_support(row, path, k) for k, row in enumerate(cast("list[Any]", rows), 1))


def _support(row: Any, path: Path, number: int) -> Support:
    def wrong(what: str) -> PoiseError:
        hint = 'Such as {"kind": "seat", "size": [0.45, 0.45, 0.45], "pos": [0, 0, 0.225]}'
        return PoiseError(f"support {number}: {what}", path, hint, code="bad-support")

    if not isinstance(row, dict):
        raise wrong("is no object")
    known = Support.__dataclass_fields__
    given = cast("dict[str, Any]", row)
    if strange := next((k for k in given if k not in known), None):
        raise wrong(f"'{str(strange)[:40]}' is not one of {', '.join(known)}")
    kind = given.get("kind", "seat")
    if kind not in get_args(Kind):
        raise wrong(f"kind must be one of {', '.join(get_args(Kind))}, got '{str(kind)[:40]}'")
    size, pos = (_vector(given.get(name)) for name in ("size", "pos"))
    if size is None or not all(LEAST_M <= x <= MOST_M for x in size):
        raise wrong(f"size must be three extents of {LEAST_M:g} to {MOST_M:g} m")
    if pos is None or not all(abs(x) <= FAR_M for x in pos):
        raise wrong(f"pos must be three numbers within {FAR_M:g} m")
    numbers: dict[str, float] = {}
    for name in ("yaw", "start_s", "stop_s", "force_n"):
        value = _number(given.get(name, known[name].default))
        if value is None:
            raise wrong(f"{name} must be a number")
        numbers[name] = value
    parts = given.get("parts", ())
    if not isinstance(parts, list | tuple) or not all(isinstance(p, str) for p in parts):
        raise wrong("parts must be a list of names")
    return Support(kind, size, pos, parts=tuple(parts), **numbers)


def _number(value: Any) -> float | None:
    good = isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)
    return float(value) if good else None


def _vector(value: Any) -> Vector | None:
    if not isinstance(value, list | tuple) or len(value) != 3:
        return None
    x, y, z = (_number(v) for v in value)
    return None if x is None or y is None or z is None else (x, y, z)


#: Edge of the cells, m, in which room is sought.
CELL_M = 0.02
#: How deep a part may stand in what bears it, m: bodies are guessed, flesh and seats give way.
SOFT_M = 0.03
#: Balls along a capsule.
BALLS = 7


def balls(
    table: BodyTable, pos: np.ndarray, quat: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A body as balls: centres `(T, K, 3)` m in the world, radii `(K,)` m and their rows `(K,)`."""
    centres: list[np.ndarray] = []
    radii: list[float] = []
    rows: list[int] = []
    for i, row in enumerate(table.rows):
        for geom in row.geoms:
            size, turn = geom.size, np.array(geom.quat)
            local, radius = [(0.0, 0.0, 0.0)], size[0]
            if geom.kind == "capsule":
                local = [(0.0, 0.0, float(z)) for z in np.linspace(-size[1], size[1], BALLS)]
            elif geom.kind == "box":
                # Its surface is as far out as the half sizes.
                local, radius = list(itertools.product(*((-x, 0.0, x) for x in size))), 0.0
            for at in local:
                inner = carried(np.array(geom.pos), turn, at)
                centres.append(carried(pos[:, i], quat[:, i], inner))
                radii.append(radius)
                rows.append(i)
    return np.stack(centres, 1), np.array(radii), np.array(rows)


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

    def __init__(self, table: BodyTable, pos: np.ndarray, quat: np.ndarray, fps: float):
        self.table, self.fps, self.pos = table, fps, pos
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


#: Half extents (m) about the points that rest: to the sides, and least of all.
AROUND: dict[Kind, float] = {"seat": 0.12, "step": 0.15, "table": 0.20, "wall": 0.35}
#: Thickness (m) where a support cannot reach down to the floor; of a wall.
BOARD_M, WALL_M = 0.05, 0.10
#: Least extent (m) of the face of a support.
THINNEST_M = 0.10
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
        if made is not None and (made[1] - made[0]).min() >= min(0.25, THINNEST_M + around):
            break
    if made is None or (made[1] - made[0]).min() < THINNEST_M:
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
        first.group.kind,
        size,
        (float(middle[0]), float(middle[1]), float(middle[2])),
        yaw,
        start / solid.fps,
        stop / solid.fps,
        tuple(dict.fromkeys(names)),
        max(f for _, f in group),
    )


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
