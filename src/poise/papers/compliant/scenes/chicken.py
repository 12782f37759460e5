"""Hopping on one leg and bumping into one another (Deep Compliant Control, Sec. 5.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from poise.body import Humanoid
from poise.body.humanoid import make_humanoid
from poise.env.events import InScene, SetDown, Throw, touches_of
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.papers.compliant.scenes.stage import Stage
from poise.sim.props import Box

#: What the other one is called in the scene.
RIVAL = "rival"
#: kg, of the paper's players.
HEAVY_KG, LIGHT_KG = 85.0, 36.0


@dataclass(frozen=True)
class Chicken:
    """A player hops on one leg and bumps into what weighs as much as its opponent: a punching bag that
    comes at it from all around, as the paper trains it, or the opponent itself, hopping, too.

    Masses scale inertia, gains and torques of the same body, so that each player alone moves alike.

    Attributes:
        mass, other: kg, of the player and its opponent.
        against: "bag" or "rival".
        speed: m/s of the bag, drawn between.
        seed: of the draws.
    """

    mass: float = HEAVY_KG
    other: float = LIGHT_KG
    against: Literal["bag", "rival"] = "bag"
    speed: tuple[float, float] = (0.8, 1.2)
    seed: int = 0

    def __post_init__(self) -> None:
        if not (2.0 <= self.mass <= 500.0 and 2.0 <= self.other <= 500.0):
            raise PoiseError(
                f"players weigh 2 to 500 kg, got {self.mass:g} and {self.other:g}", "chicken"
            )
        if self.against not in ("bag", "rival"):
            raise PoiseError(f"it is played against a bag or a rival, got '{self.against}'", "chicken")

    def stage(self, humanoid: Humanoid, reference: Reference) -> Stage:
        """The bag, its throws and all touches with it; of a rival the touches alone."""
        name = "bag" if self.against == "bag" else RIVAL
        touches = touches_of("felt", name, humanoid.bodies)
        felt = tuple(t.name for t in touches)
        if self.against == "rival":
            return Stage((), (), touches, (InScene(felt=felt),), from_start=True)
        chest = humanoid.bodies[(humanoid.rows_of("spine") or (0,))[-1]]
        far = SetDown(name, (30.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0))
        throw = Throw(name, chest, self.speed, 1.0, (2.0, 2.0), (-0.1, 0.1), self.seed)
        bag = Box(name, (0.35, 0.35, 0.9), (30.0, 0.0, 0.5), mass=self.other)
        return Stage((bag,), (), touches, (InScene(felt=felt, events=(far, throw)),), from_start=True)


def weighing(humanoid: Humanoid, kg: float) -> Humanoid:
    """The same body with another mass; inertia, gains and torques grow with it.

    What it does under the same angles of its servos stays the same, and so does its policy.
    """
    table = humanoid.table
    s = kg / table.mass
    rows = tuple(
        replace(
            r, mass=s * r.mass, kp=s * r.kp, kd=s * r.kd, torque=s * r.torque, armature=s * r.armature
        )
        for r in table.rows
    )
    return make_humanoid(humanoid.skeleton, replace(table, rows=rows))
