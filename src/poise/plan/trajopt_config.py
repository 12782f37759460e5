"""What a search for paths is told, what it finds, and what its iterations come to."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from poise.errors import PoiseError
from poise.plan.expert import ExpertConfig


@dataclass(frozen=True)
class TrajOptConfig:
    """How paths are searched.

    iterations: of the search; 0 searches none. sizes: rad, of the differences in the first and in the
    last iteration, see `plan.linear_model`. stretch_s: seconds of which each chooses its own step.
    place_m, turn, joint: errors that cost 1, of the root's place in m and attitude and of a joint in
    rad; speed, spin, joint_speed: of their velocities. effort: rad of a joint's target, likewise.
    help_n, help_nm: the wrench that costs 1 at first. less: what is left of that after an iteration
    on stretches whose mean error cost is below `good`; more comes back above `bad`, up to the whole.
    least: the share that help ends at, which is next to nothing; paths themselves are without.
    astray: cost from which on a stretch begins again on its reference, with the help of three
    iterations ago.
    steps: of which the best is taken. lost: error of a whole body, in units of what costs 1, beyond
    which a step is no choice. blur: the feedback of a frame is the mean over so many frames before
    and after it: from frame to frame it jumps, which a network learns last.
    """

    iterations: int = 11
    sizes: tuple[float, float] = (0.1, 0.065)
    stretch_s: float = 2.0
    place_m: float = 0.3
    turn: float = 0.4
    joint: float = 0.5
    speed: float = 1.5
    spin: float = 4.0
    joint_speed: float = 8.0
    effort: float = 0.5
    help_n: float = 100.0
    help_nm: float = 30.0
    less: float = 0.6
    least: float = 0.02
    good: float = 4.0
    bad: float = 10.0
    astray: float = 25.0
    steps: tuple[float, ...] = (1.0, 0.6, 0.3, 0.1, 0.03, 0.0)
    lost: float = 1.2
    blur: int = 3
    plan: ExpertConfig = field(default_factory=ExpertConfig)

    def __post_init__(self) -> None:
        if self.iterations < 0 or not 0 < self.less < 1 or min(*self.sizes, self.stretch_s) <= 0:
            what = "iterations must not be negative, less lie in (0, 1), sizes and stretch_s be above 0"
            raise PoiseError(what, "TrajOptConfig")
        if 0.0 not in self.steps:
            raise PoiseError("one of the steps must be 0, with which a path stays", "TrajOptConfig")

    def size(self, iteration: int) -> float:
        """Of the differences, falling geometrically."""
        first, last = self.sizes
        return first * (last / first) ** min(1.0, iteration / max(1, self.iterations - 1))


@dataclass(frozen=True, eq=False)
class Trajectories:
    """One path per clip; row r stands where row r of the reference does.

    qpos `(F, nq)`, qvel `(F, nv)`, float64. target `(F, n)` rad and feedback `(F, n, 2 nv)`: servo
    targets, and how they change with the deviation (`sim.difference`, then velocities); float32.
    price `(2 nv)`: what the squares of deviations cost in the search.
    """

    qpos: Tensor
    qvel: Tensor
    target: Tensor
    feedback: Tensor
    price: Tensor


@dataclass(frozen=True)
class TrajOptStats:
    """What an iteration came to, over all frames.

    error_m: mean distance of the root from the reference. help_n: mean force that still helps.
    unhelped: share of the frames where help has ended. seconds: of all iterations.
    """

    iteration: int
    error_m: float
    help_n: float
    unhelped: float
    seconds: float
