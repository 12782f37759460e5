"""How mass and strength follow the height, so that a child and a giant stand and move alike.

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

from poise.body import presets

#: Heights (m) at which the gains are those that were tried: L has no effect within.
ADULT_M = (1.55, 1.80)
#: Body mass index of children up to 1.2 m; it rises in a line to the adult's 22 at 1.55 m.
CHILD_MASS_INDEX, CHILD_M, GROWN_M = 16.0, 1.20, 1.55
#: Beyond this height (m) mass grows with the cube of the height, as bodies of one shape do.
GIANT_M = 2.0


@dataclass(frozen=True)
class Strength:
    """Factors on the numbers that are stated at `presets.RFC_MASS_KG`.

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
        m, length = mass_kg / presets.RFC_MASS_KG, length_factor(height_m)
        return cls(m * length, length**0.5, m * length**2)


def length_factor(height_m: float) -> float:
    """L: 1 for adults of `ADULT_M`, else the height over the nearer edge of that span."""
    return height_m / float(np.clip(height_m, *ADULT_M))


def default_mass(height_m: float) -> float:
    """Mass (kg) of a person of this height.

    Body mass index 22 for adults; 16 for children up to `CHILD_M` (the median of boys and girls of
    that height), rising in a line to `GROWN_M`; above `GIANT_M` the index grows with the height.
    """
    adult = presets.BODY_MASS_INDEX
    if height_m > GIANT_M:
        return adult * height_m**3 / GIANT_M
    return float(np.interp(height_m, (CHILD_M, GROWN_M), (CHILD_MASS_INDEX, adult))) * height_m**2
