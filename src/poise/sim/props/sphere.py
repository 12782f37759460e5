"""A ball."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from poise.sim.props.prop import Vector, above_zero, solid


@dataclass(frozen=True)
class Ball:
    """A free ball.

    Attributes:
        name: how the scene calls it.
        radius: m.
        mass: kg.
        pos: m, its centre at first.
    """

    name: str = "ball"
    radius: float = 0.12
    mass: float = 0.6
    pos: Vector = (0.0, 0.0, 0.12)

    def __post_init__(self) -> None:
        above_zero(f"Ball '{self.name}'", radius=self.radius, mass=self.mass)

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos))
        body.add_freejoint(name=self.name)
        solid(body, self.name, "sphere", [self.radius], mass=self.mass)
