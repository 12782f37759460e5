"""Numbers of human bodies: segment masses and sizes, gains and torque limits by part.

Masses are fractions of the whole body (Winter 2009, table 4.1; the trunk's 0.497 is shared by the
pelvis 0.142 and the spine). Radii are fractions of the standing height. Gains are those of the
Residual Force Control humanoid (kp in N m/rad, torque limits 50 to 200 N m for a body of 31 kg) and
scale with the body, so that every character, a child and a giant too, stands and moves alike.

Two bodies of one shape move alike under gravity when their Froude numbers agree (Alexander and Jayes
1983; Hof 1996): with mass m and length L, times go as sqrt(L / g) and

    torque ~ m g L,   stiffness ~ m g L,   damping ~ m g L sqrt(L / g),   inertia ~ m L^2.

Gravity is the same for all, so each is a power of m and L. The gains of Residual Force Control were
tried, and every published result of Poise was made, on adults of `ADULT_M`; within that span they
follow the mass alone (which stands at most 8 % beside the rule), beyond it L counts from its edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Mass of the humanoid for which Residual Force Control states its gains, kg.
RFC_MASS_KG = 31.0
#: Standing height over the length of thigh and shin together (Winter: 0.245 + 0.246).
HEIGHT_PER_LEG = 1.0 / 0.491
#: Default mass of an adult: body mass index 22 (`default_mass`).
BODY_MASS_INDEX = 22.0


@dataclass(frozen=True)
class PartNumbers:
    """What a preset states about a kind of part, at `RFC_MASS_KG`.

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
    """Factors on the numbers that are stated at `RFC_MASS_KG`.

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
