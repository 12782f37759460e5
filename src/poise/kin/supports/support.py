"""A thing that a motion rests on: a box that stands in the world."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

from poise.errors import PoiseError

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
        raise PoiseError(f"cannot be read: {problem.strerror}", path) from None
    except (ValueError, RecursionError) as problem:
        raise PoiseError(f"is no JSON: {str(problem)[:80]}", path) from None
    rows = held if isinstance(held, list) else [held]
    if not rows or len(rows) > 500:
        raise PoiseError(f"holds {len(rows)} supports; there can be 1 to 500", path)
    return tuple(_support(row, path, k) for k, row in enumerate(cast("list[Any]", rows), 1))


def _support(row: Any, path: Path, number: int) -> Support:
    def wrong(what: str) -> PoiseError:
        hint = 'Such as {"kind": "seat", "size": [0.45, 0.45, 0.45], "pos": [0, 0, 0.225]}'
        return PoiseError(f"support {number}: {what}", path, hint)

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
