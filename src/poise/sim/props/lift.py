"""A plate that an actuator slides up and down: a lift, a trampoline, a moving step."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from poise.sim.props.prop import Vector, above_zero, solid


@dataclass(frozen=True)
class Lift:
    """A plate on a vertical slide, driven toward a height by a spring and a damper.

    It has one coordinate, the height above `pos`, m, and one control, the height wanted.

    Attributes:
        name: how the scene calls it.
        size: `(x, y)` m.
        pos: m, the middle of its upper face at height 0.
        mass: kg.
        stiffness: N/m.
        damping: N s/m.
        travel: m, how far up and down.
    """

    name: str = "lift"
    size: tuple[float, float] = (1.5, 1.5)
    pos: Vector = (0.0, 0.0, 0.3)
    mass: float = 20.0
    stiffness: float = 2e4
    damping: float = 500.0
    travel: float = 0.3

    def __post_init__(self) -> None:
        numbers = {k: getattr(self, k) for k in ("size", "mass", "stiffness", "damping", "travel")}
        above_zero(f"Lift '{self.name}'", **numbers)

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body with a slide and its actuator."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos), gravcomp=1.0)
        body.add_joint(
            name=self.name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], limited=True,
            range=[-self.travel, self.travel], damping=[self.damping, 0, 0],
        )  # fmt: skip
        half, x, y = 0.02, *self.size
        at = [0.0, 0.0, -half]
        solid(body, self.name, "box", [x / 2, y / 2, half], pos=at, mass=self.mass)
        servo = spec.add_actuator(
            name=self.name, target=self.name, trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED, biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        )  # fmt: skip
        servo.gainprm[0], servo.biasprm[1] = self.stiffness, -self.stiffness
