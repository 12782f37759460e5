"""The generated parameters of a humanoid: a plain table that can be printed and overridden."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from poise.errors import PoiseError, did_you_mean


@dataclass(frozen=True)
class Geom:
    """A rigid shape in its body's frame.

    Attributes:
        kind: "capsule" (along local z), "box" or "sphere".
        size: m; capsule (radius, half length), box (half sizes), sphere (radius).
        pos: m.
        quat: wxyz.
    """

    kind: str
    size: tuple[float, float, float]
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class BodyRow:
    """One rigid body and the hinges that move it against its parent body.

    Attributes:
        name: of the body.
        joint: index of the skeleton joint that this body carries the frame of.
        kind: of its part.
        side: of its part.
        parent: index of the parent row, -1 for the pelvis.
        pos: m, place in the parent body's frame at zero angles.
        quat: wxyz, orientation there.
        order: hinge axes, first the one nearest the parent, as letters of `frame` ("ZYX"; "" is rigid).
        frame: wxyz, the axes' frame in the body's frame.
        ranges: (low, high) rad per hinge.
        mass: kg.
        kp: N m/rad.
        kd: N m s/rad.
        torque: N m, limit.
        armature: kg m^2.
        geoms: rigid shapes.
    """

    name: str
    joint: int
    kind: str
    side: str
    parent: int
    pos: tuple[float, float, float]
    quat: tuple[float, float, float, float]
    order: str
    frame: tuple[float, float, float, float]
    ranges: tuple[tuple[float, float], ...]
    mass: float
    kp: float
    kd: float
    torque: float
    armature: float
    geoms: tuple[Geom, ...]

    def hinge_names(self) -> tuple[str, ...]:
        """Names of this body's hinges: "lfemur_z", "lfemur_y", "lfemur_x"."""
        return tuple(f"{self.name}_{letter.lower()}" for letter in self.order)


@dataclass(frozen=True)
class BodyTable:
    """All rows of a humanoid, parents first.

    Attributes:
        rows: one per body.
        height_m: m, standing height estimated from the legs.
        friction: sliding friction of the soles.
        contact_exclusions: pairs of body names that never collide.
    """

    rows: tuple[BodyRow, ...]
    height_m: float
    friction: float = 1.0
    contact_exclusions: tuple[tuple[str, str], ...] = ()

    @property
    def mass(self) -> float:
        """Total mass, kg."""
        return sum(r.mass for r in self.rows)

    def index(self, name: str) -> int:
        """Row of the body called `name`."""
        names = tuple(r.name for r in self.rows)
        if name not in names:
            raise PoiseError(f"there is no body '{name}'. {did_you_mean(name, names)}")
        return names.index(name)

    def overridden(self, changes: Mapping[str, float]) -> BodyTable:
        """The table with values replaced by name: `{"lfoot.kp": 400, "thigh.torque": 250}`.

        Keys are `<body>.<field>` with field one of mass, kp, kd, torque, armature, or `<part>.<field>`
        for all bodies of a part ("thigh.torque"), or "friction".
        """
        table = self
        fields = ("mass", "kp", "kd", "torque", "armature")
        for key, value in changes.items():
            if not math.isfinite(value) or value < 0:
                raise PoiseError(f"'{key}' must be a number of at least 0, got {value}")
            if key == "friction":
                table = replace(table, friction=float(value))
                continue
            name, _, what = key.rpartition(".")
            kinds = {r.kind for r in table.rows}
            if what not in fields or not name:
                raise PoiseError(
                    f"'{key}' is no parameter of a body; write BODY.FIELD with FIELD one of "
                    f"{', '.join(fields)}"
                )
            if name not in kinds:
                table.index(name)
            rows = tuple(
                replace(r, **{what: float(value)}) if name in (r.name, r.kind) else r for r in table.rows
            )
            table = replace(table, rows=rows)
        return table

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> BodyTable:
        """What `to_dict` gave, or JSON made of it.

        Raises:
            KeyError, TypeError: a value is missing or unknown.
        """
        rows = []
        for row in data["rows"]:
            plain = {k: _tuples(v) for k, v in row.items() if k != "geoms"}
            geoms = tuple(Geom(**{k: _tuples(v) for k, v in geom.items()}) for geom in row["geoms"])
            rows.append(BodyRow(**plain, geoms=geoms))
        rest = {k: _tuples(v) for k, v in data.items() if k != "rows"}
        return cls(tuple(rows), **rest)

    def describe(self) -> list[dict[str, object]]:
        """One plain dict per body, for printing: masses kg, gains N m/rad, ranges degrees."""
        return [
            {
                "body": r.name,
                "part": r.kind,
                "parent": self.rows[r.parent].name if r.parent >= 0 else "world",
                "mass": round(r.mass, 3),
                "hinges": r.order or "-",
                "kp": round(r.kp, 1) if r.order else 0.0,
                "kd": round(r.kd, 2) if r.order else 0.0,
                "torque": round(r.torque, 1) if r.order else 0.0,
                "range_deg": [(round(math.degrees(a)), round(math.degrees(b))) for a, b in r.ranges],
                "shape": "+".join(g.kind for g in r.geoms),
            }
            for r in self.rows
        ]


def _tuples(value: Any) -> Any:
    """Lists to tuples, all the way down, since JSON knows only lists."""
    return tuple(_tuples(v) for v in value) if isinstance(value, list | tuple) else value


def floats(values: Any) -> Any:
    """A vector or quaternion as a plain tuple."""
    return tuple(float(v) for v in values)
