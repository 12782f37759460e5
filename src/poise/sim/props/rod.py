"""A rod with a ball on its upper end."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from poise.sim.props.prop import Vector, above_zero, solid


@dataclass(frozen=True)
class Rod:
    """A free rod that stands on its lower end and carries a ball on the upper one; one body, with the
    lower end as its origin. Nothing touches it, so that what it stands on must be a link.

    Attributes:
        name: how the scene calls it.
        length: m, from the lower end to the ball's centre.
        radius: m, of the ball.
        mass: kg, of the ball; the rod has a tenth of it.
        pos: m, its lower end at first.
    """

    name: str = "rod"
    length: float = 1.0
    radius: float = 0.08
    mass: float = 0.5
    pos: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        sizes = {k: getattr(self, k) for k in ("length", "radius", "mass")}
        above_zero(f"Rod '{self.name}'", **sizes)

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos))
        body.add_freejoint(name=self.name)
        rod, ball = [0.0, 0.0, self.length / 2], [0.0, 0.0, self.length]
        thin = [0.015, self.length / 2]
        geoms = (
            solid(body, f"{self.name}/rod", "capsule", thin, pos=rod, mass=0.1 * self.mass),
            solid(body, f"{self.name}/ball", "sphere", [self.radius], pos=ball, mass=self.mass),
        )
        for geom in geoms:
            geom.contype = geom.conaffinity = 0
