"""Obstacles thrown at the character (Deep Compliant Control, Sec. 5.2)."""

from __future__ import annotations

from dataclasses import dataclass

from poise.body import Humanoid
from poise.env.events import InScene, SetDown, Throw, touches_of
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.papers.compliant.scenes.stage import Stage
from poise.sim import Touch
from poise.sim.props import Ball


@dataclass(frozen=True)
class Throws:
    """A ball that comes at the chest from all around, again and again.

    Attributes:
        mass: kg.
        speed: m/s along the ground, drawn between.
        every_s: s between throws, drawn between.
        seed: of the draws.
    """

    mass: float = 1.0
    speed: tuple[float, float] = (2.0, 3.0)
    every_s: tuple[float, float] = (1.0, 1.5)
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.mass < 100.0:
            raise PoiseError(f"a ball must weigh above 0 and below 100 kg, got {self.mass:g}", "throws")

    def stage(self, humanoid: Humanoid, reference: Reference) -> Stage:
        """A ball that waits far off, touches of each body, and throws; "hit" is metered."""
        chest = (humanoid.rows_of("spine") or (0,))[-1]
        touches = touches_of("felt", "ball", humanoid.bodies)
        hit = Touch("hit", "ball", "character")
        part = InScene(
            metered=(hit.name,),
            felt=tuple(t.name for t in touches),
            events=(
                SetDown("ball", (30.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0)),
                Throw("ball", humanoid.bodies[chest], self.speed, every_s=self.every_s, seed=self.seed),
            ),
        )
        return Stage((Ball(mass=self.mass),), (), (*touches, hit), (part,))
