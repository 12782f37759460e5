"""The parameters of a humanoid as a table that can be printed and overridden; numbers of bodies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

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


#: s, MuJoCo's own time constant of contacts.
HARD_S = 0.02


@dataclass(frozen=True)
class BodyTable:
    """All rows of a humanoid, parents first.

    Attributes:
        rows: one per body.
        height_m: m, standing height estimated from the legs.
        friction: sliding friction of the soles.
        contact_exclusions: pairs of body names that never collide.
        soft_s: s, time constant of contacts (MuJoCo's `solref`): how soft flesh and soles are.
    """

    rows: tuple[BodyRow, ...]
    height_m: float
    friction: float = 1.0
    contact_exclusions: tuple[tuple[str, str], ...] = ()
    soft_s: float = HARD_S

    @property
    def mass(self) -> float:
        """Total mass, kg."""
        return sum(r.mass for r in self.rows)

    def index(self, name: str) -> int:
        """Row of the body called `name`."""
        names = tuple(r.name for r in self.rows)
        if name not in names:
            raise PoiseError(
                f"there is no body '{name}'. {did_you_mean(name, names)}", code="unknown-body"
            )
        return names.index(name)

    def overridden(self, changes: Mapping[str, float]) -> BodyTable:
        """The table with values replaced by name: `{"lfoot.kp": 400, "thigh.torque": 250}`.

        Keys are `<body>.<field>` with field one of mass, kp, kd, torque, armature, or `<part>.<field>`
        for all bodies of a part ("thigh.torque"), or "friction" or "soft_s".
        """
        table = self
        fields = ("mass", "kp", "kd", "torque", "armature")
        for key, value in changes.items():
            if not math.isfinite(value) or value < 0:
                raise PoiseError(
                    f"'{key}' must be a number of at least 0, got {value}", code="out-of-range"
                )
            if key in ("friction", "soft_s"):
                table = replace(table, **{key: float(value)})
                continue
            name, _, what = key.rpartition(".")
            kinds = {r.kind for r in table.rows}
            if what not in fields or not name:
                raise PoiseError(
                    f"'{key}' is no parameter of a body; write BODY.FIELD with FIELD one of "
                    f"{', '.join(fields)}",
                    code="unknown-setting",
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


#: Mass of the humanoid for which Residual Force Control states its gains, kg.
RFC_MASS_KG = 31.0
#: Standing height over the length of thigh and shin together (Winter: 0.245 + 0.246).
HEIGHT_PER_LEG = 1.0 / 0.491
#: Default mass of an adult: body mass index 22 (`default_mass`).
BODY_MASS_INDEX = 22.0


@dataclass(frozen=True)
class PartNumbers:
    """What a preset states about a kind of part, at `RFC_MASS_KG`.

    Masses are those of Winter 2009, table 4.1; the pelvis and the spine with the clavicles share the
    trunk's 0.497. Gains and torque limits are those of the Residual Force Control humanoid.

    Attributes:
        mass: fraction of body mass (both sides each).
        radius: fraction of the height.
        kp: N m/rad.
        torque: N m.
        dofs: hinges on a skeleton that states none.
    """

    mass: float
    radius: float
    kp: float
    torque: float
    dofs: int


PARTS: dict[str, PartNumbers] = {
    "pelvis": PartNumbers(0.142, 0.062, 0.0, 0.0, 0),
    "spine": PartNumbers(0.335, 0.060, 1000.0, 200.0, 3),
    "neck": PartNumbers(0.021, 0.030, 200.0, 50.0, 3),
    "head": PartNumbers(0.060, 0.052, 200.0, 50.0, 0),
    "clavicle": PartNumbers(0.010, 0.028, 400.0, 100.0, 3),
    "upper_arm": PartNumbers(0.028, 0.026, 400.0, 100.0, 3),
    "forearm": PartNumbers(0.016, 0.021, 300.0, 75.0, 3),
    "hand": PartNumbers(0.006, 0.023, 100.0, 50.0, 0),
    "thigh": PartNumbers(0.100, 0.042, 500.0, 200.0, 3),
    "shin": PartNumbers(0.0465, 0.030, 500.0, 150.0, 3),
    "foot": PartNumbers(0.0145, 0.018, 400.0, 100.0, 3),
}

#: Parts of which the degrees of freedom in an ASF are dropped by the Residual Force Control humanoid:
#: 32 hinges and 20 bodies remain of CMU's 56 and 31. The CMU data hold the clavicles at zero.
CMU_RIGID = ("clavicle", "hand")
#: CMU joints with bodies that ride rigidly on `lowerneck`.
CMU_RIGID_JOINTS = ("head",)
#: CMU joints without a body of their own.
CMU_MERGED = ("upperneck",)

#: Ankle above the sole, foot length, heel behind the ankle, foot width: fractions of the height.
ANKLE_HEIGHT, FOOT_LENGTH, HEEL_LENGTH, FOOT_WIDTH = 0.039, 0.152, 0.040, 0.055
#: How far the rigid sole reaches beyond the toe joint, a fraction of the height.
BEYOND_BALL = 0.02
#: Heights (m) at which the gains are those that were tried: L has no effect within.
ADULT_M = (1.55, 1.80)
#: Body mass index of children up to 1.2 m; it rises in a line to the adult's 22 at 1.55 m.
CHILD_MASS_INDEX, CHILD_M, GROWN_M = 16.0, 1.20, 1.55
#: Beyond this height (m) mass grows with the cube of the height, as bodies of one shape do.
GIANT_M = 2.0


@dataclass(frozen=True)
class Strength:
    """Factors on the numbers that are stated at `RFC_MASS_KG`, for a child and a giant, too.

    Two bodies of one shape move alike under gravity when their Froude numbers agree (Alexander and Jayes
    1983; Hof 1996). With mass m and length L, times go as sqrt(L / g) and

        torque ~ m g L,   stiffness ~ m g L,   damping ~ m g L sqrt(L / g),   inertia ~ m L^2.

    Gravity is the same for all, so each factor is a power of m and L. The gains were tried on adults of
    `ADULT_M`: within that span they follow the mass alone, beyond it L counts from its edge.

    Attributes:
        torque: of torque limits and stiffness, m L.
        time: sqrt(L), so that damping goes as torque x time.
        inertia: m L^2, of the armature.
    """

    torque: float
    time: float
    inertia: float

    @classmethod
    def of(cls, mass_kg: float, height_m: float) -> Strength:
        """The factors for a body of this mass and standing height."""
        m, length = mass_kg / RFC_MASS_KG, length_factor(height_m)
        return cls(m * length, length**0.5, m * length**2)


def leg_length(table: BodyTable) -> float:
    """m, from hip to knee and on to ankle, the mean of both legs."""
    rows = [r for r in table.rows if r.kind in ("shin", "foot")]
    return sum(math.dist(r.pos, (0.0, 0.0, 0.0)) for r in rows) / 2.0


def length_factor(height_m: float) -> float:
    """L: 1 for adults of `ADULT_M`, else the height over the nearer edge of that span."""
    return height_m / float(np.clip(height_m, *ADULT_M))


def default_mass(height_m: float) -> float:
    """Mass (kg) of a person of this height.

    Body mass index 22 for adults; 16 for children up to `CHILD_M` (the median of boys and girls of
    that height), rising in a line to `GROWN_M`; above `GIANT_M` the index grows with the height.
    """
    adult = BODY_MASS_INDEX
    if height_m > GIANT_M:
        return adult * height_m**3 / GIANT_M
    return float(np.interp(height_m, (CHILD_M, GROWN_M), (CHILD_MASS_INDEX, adult))) * height_m**2
