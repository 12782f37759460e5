"""A kinematic body: it goes where it is told, and carries what touches it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from poise.sim.props.prop import Vector, above_zero, solid

#: kg; what touches it hardly moves it between two control steps.
MASS = 1e5
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Carrier:
    """A plate with a motion of its own: a moving walkway, a hand that leads, a vehicle.

    A mocap body of MuJoCo has no velocity, so that it carries nothing and pulls with a lag. This one is
    so heavy that nothing turns it from its way: set its four coordinates (x, y, z in m from `pos`, and
    the turn about Z in rad) and their rates each control step (`SceneSim.place`), and it keeps that
    velocity until the next.

    Attributes:
        name: how the scene calls it.
        size: m, its full extents.
        pos: m, its centre at coordinates 0.
        touched: whether things touch it; a hand that leads by a link need not be touched.
    """

    name: str = "carrier"
    size: Vector = (1.0, 1.0, 0.1)
    pos: Vector = (0.0, 0.0, 0.05)
    touched: bool = True

    def __post_init__(self) -> None:
        above_zero(f"Carrier '{self.name}'", size=self.size)

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body on three slides and a hinge."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos), gravcomp=1.0)
        for axis, along in AXES.items():
            slide = mujoco.mjtJoint.mjJNT_SLIDE
            body.add_joint(name=f"{self.name}/{axis}", type=slide, axis=list(along))
        hinge = mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(name=f"{self.name}/turn", type=hinge, axis=[0, 0, 1])
        geom = solid(body, self.name, "box", [s / 2 for s in self.size], mass=MASS)
        if not self.touched:
            geom.contype = geom.conaffinity = 0
        # The floor would hold it back.
        spec.add_exclude(bodyname1="world", bodyname2=self.name)
