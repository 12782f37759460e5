"""A trampoline: a rigid plate on four linear actuators (Deep Compliant Control, Sec. 5.3)."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from poise.sim.props.prop import Vector, above_zero, solid


@dataclass(frozen=True)
class Trampoline:
    """A plate that a spring and a damper at each corner hold at a height that is its control.

    It has three coordinates, the height above `pos`, m, and its tilts about X and Y, rad, and four
    controls, the heights wanted of the corners. Its own weight is carried.

    Attributes:
        name: how the scene calls it.
        size: `(x, y)` m.
        pos: m, the middle of its upper face at rest.
        mass: kg.
        stiffness: N/m, of each corner.
        damping: N s/m, of each corner.
    """

    name: str = "trampoline"
    size: tuple[float, float] = (2.4, 2.4)
    pos: Vector = (0.0, 0.0, 0.0)
    mass: float = 20.0
    stiffness: float = 4000.0
    damping: float = 120.0

    def __post_init__(self) -> None:
        numbers = {k: getattr(self, k) for k in ("size", "mass", "stiffness", "damping")}
        above_zero(f"Trampoline '{self.name}'", **numbers)

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body on a slide and two hinges, and its actuators "NAME/0" to "NAME/3"."""
        half, (x, y) = 0.02, self.size
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos), gravcomp=1.0)
        for kind, name, axis in (("SLIDE", "z", 2), ("HINGE", "x", 0), ("HINGE", "y", 1)):
            along = [float(i == axis) for i in range(3)]
            joint = getattr(mujoco.mjtJoint, f"mjJNT_{kind}")
            body.add_joint(name=f"{self.name}/{name}", type=joint, axis=along)
        solid(body, self.name, "box", [x / 2, y / 2, half], pos=[0.0, 0.0, -half], mass=self.mass)
        for k, (sx, sy) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
            name, corner = f"{self.name}/{k}", [sx * x / 2, sy * y / 2, 0.0]
            body.add_site(name=name, pos=corner)
            foot = [a + b for a, b in zip(self.pos, corner, strict=True)]
            spec.worldbody.add_site(name=f"{name}/foot", pos=foot)
            servo = spec.add_actuator(
                name=name, target=name, refsite=f"{name}/foot", trntype=mujoco.mjtTrn.mjTRN_SITE,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED, biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                gear=[0, 0, 1, 0, 0, 0],
            )  # fmt: skip
            servo.gainprm[0], servo.biasprm[1], servo.biasprm[2] = (
                self.stiffness, -self.stiffness, -self.damping,
            )  # fmt: skip
