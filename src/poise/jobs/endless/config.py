"""How characters go about without end."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from poise.env.goals.steering import Steering
from poise.errors import PoiseError
from poise.plan import LookaheadConfig
from poise.settings import validate

#: The most characters in a world.
MOST = 16


@dataclass(frozen=True)
class Dream:
    """How characters go about.

    Attributes:
        temperature: deviation of what the kinematic policy draws; below 1 motion is more usual.
        count: characters in one world, which keep away from each other.
        targets: x and y, in m, of points that each character is to reach one after another; it begins at
            the origin.
        seed: of all draws.
        controller: the policy looks ahead before it acts, or acts at once.
        lookahead: how it looks ahead; its seed is `seed`.
        recover: a character that has fallen gets up and goes on.
        past: what the kinematic policy goes on from: its own frames, as the paper has it, or what the
            character did.
        style: label of the motion of the library that is done, where that has labels; None does all.
        label_seconds: s for which, on average, a character keeps to motion of one label of the library
            before it turns to another one; 0 leaves that to chance, as targets and a style do.
        hold_feet: standing feet are held in place in what is written.
        threads: cores of lookahead, 0 is all of them.
    """

    temperature: float = 1.0
    count: int = 1
    targets: tuple[tuple[float, float], ...] = ()
    seed: int = 0
    controller: Literal["lookahead", "policy"] = "lookahead"
    lookahead: LookaheadConfig = field(default_factory=LookaheadConfig)
    recover: bool = True
    past: Literal["own", "simulated"] = "own"
    style: str | None = None
    label_seconds: float = 10.0
    hold_feet: bool = True
    threads: int = 0

    def __post_init__(self) -> None:
        validate(self)
        if not 1 <= self.count <= MOST:
            raise PoiseError(f"there may be 1 to {MOST} characters, got {self.count}")
        if not 0 <= self.temperature <= 10:
            raise PoiseError(f"the temperature must lie in 0 to 10, got {self.temperature:g}")
        if not 0 <= self.label_seconds <= 3600:
            raise PoiseError(f"a label is kept to for 0 to 3600 s, got {self.label_seconds:g}")
        Steering(self.targets)
