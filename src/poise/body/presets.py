"""Numbers of human bodies: segment masses and sizes, gains and torque limits by part.

Masses are fractions of the whole body (Winter 2009, table 4.1; the trunk's 0.497 is shared by the
pelvis 0.142 and the spine). Radii are fractions of the standing height. Gains are those of the
Residual Force Control humanoid (kp in N m/rad, torque limits 50 to 200 N m for a body of 31 kg) and
scale with the body, so that every character moves alike (`scaling.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

#: Mass of the humanoid for which Residual Force Control states its gains, kg.
RFC_MASS_KG = 31.0
#: Standing height over the length of thigh and shin together (Winter: 0.245 + 0.246).
HEIGHT_PER_LEG = 1.0 / 0.491
#: Default mass of an adult: body mass index 22 (`scaling.default_mass`).
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
