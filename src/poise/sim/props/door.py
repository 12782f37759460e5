"""A door on a hinge, with a knob on either side."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from poise.sim.props.prop import Vector, above_zero, solid

#: From the door's free edge to the knobs, their height above its lower edge, and their radius, m.
KNOB_IN, KNOB_UP, KNOB_R = 0.07, 1.0, 0.03


@dataclass(frozen=True)
class Door:
    """A leaf that turns about the vertical through its hinge; closed it reaches along +Y.

    It has one coordinate, the angle it is open, rad.

    Attributes:
        name: how the scene calls it.
        pos: m, the foot of its hinge.
        width, height, thickness: of the leaf, m.
        mass: kg.
        opens: rad, how far to either side.
        damping: N m s/rad, of the hinge.
        friction: N m, of the hinge.
        knob_up: m, of the knobs above the foot of the hinge.
    """

    name: str = "door"
    pos: Vector = (1.0, -0.45, 0.0)
    width: float = 0.9
    height: float = 2.0
    thickness: float = 0.04
    mass: float = 20.0
    opens: float = 2.0
    damping: float = 1.0
    friction: float = 0.5
    knob_up: float = KNOB_UP

    @property
    def knob(self) -> Vector:
        """The front knob's centre, m, in the leaf's frame."""
        return -(self.thickness / 2 + KNOB_R), self.width - KNOB_IN, self.knob_up

    def __post_init__(self) -> None:
        sizes = {k: getattr(self, k) for k in ("width", "height", "thickness", "mass", "opens")}
        above_zero(f"Door '{self.name}'", **sizes)

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body with a hinge; the geoms of the knobs are "NAME/knob_front" (toward -X) and
        "NAME/knob_back"."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos))
        body.add_joint(
            name=self.name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1],
            range=[-self.opens, self.opens], limited=True, damping=[self.damping, 0, 0],
            frictionloss=self.friction,
        )  # fmt: skip
        gap = 0.01
        half = [self.thickness / 2, self.width / 2, (self.height - gap) / 2]
        at = [0.0, self.width / 2, gap + half[2]]
        solid(body, f"{self.name}/leaf", "box", half, pos=at, mass=0.97 * self.mass)
        for side, sign in (("front", -1.0), ("back", 1.0)):
            at = [-sign * self.knob[0], *self.knob[1:]]
            name, share = f"{self.name}/knob_{side}", 0.015 * self.mass
            solid(body, name, "sphere", [KNOB_R], pos=at, mass=share)
