"""A box: free, or fixed to the world as furniture is."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from poise.sim.props.prop import Vector, above_zero, solid


@dataclass(frozen=True)
class Box:
    """A box.

    Attributes:
        name: how the scene calls it.
        size: m, its full extents.
        pos: m, its centre at first.
        quat: wxyz, box to world at first.
        mass: kg; 0 fixes it to the world.
    """

    name: str = "box"
    size: Vector = (0.4, 0.4, 0.4)
    pos: Vector = (0.0, 0.0, 0.2)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    mass: float = 0.0

    def __post_init__(self) -> None:
        above_zero(f"Box '{self.name}'", size=self.size)
        if self.mass != 0.0:
            above_zero(f"Box '{self.name}'", mass=self.mass)

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos), quat=list(self.quat))
        if self.mass:
            body.add_freejoint(name=self.name)
        solid(body, self.name, "box", [s / 2 for s in self.size], mass=self.mass)
