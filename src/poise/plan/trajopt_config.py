"""Settings, results and statistics of trajectory optimisation."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from poise.errors import PoiseError
from poise.plan.expert import ExpertConfig


@dataclass(frozen=True)
class TrajOptConfig:
    """How trajectories are optimised.

    Attributes:
        iterations: number of iterations; 0 optimises nothing.
        sizes: rad, of the differences in the first and in the last iteration, see `plan.lqr`.
        segment_s: seconds of a shooting segment; each segment chooses its own step.
        place_m: m, error of the root's place that costs 1.
        turn: rad, error of the root's attitude that costs 1.
        joint: rad, error of a joint that costs 1.
        speed: m/s, error of the root's velocity that costs 1.
        spin: rad/s, error of the root's angular velocity that costs 1.
        joint_speed: rad/s, error of a joint's velocity that costs 1.
        effort: rad, deviation of a joint's target that costs 1.
        help_n: N, force on the root that costs 1 at first.
        help_nm: N m, torque on the root that costs 1 at first.
        less: factor on the help after an iteration in segments with a mean error cost below `good`.
        least: share at which the help ends, next to nothing; the trajectories themselves are without
            help.
        good: mean error cost of a segment below which its help becomes less.
        bad: mean error cost of a segment above which its help comes back, up to the whole.
        astray: mean error cost from which on a segment begins again on its reference, with the help
            of three iterations ago.
        steps: step sizes of the line search, of which the best is taken.
        lost: error of a whole body, in units of what costs 1, beyond which a step is no choice.
        blur: the feedback of a frame is the mean over so many frames before and after it; from frame to
            frame it jumps, which a network learns last.
        plan: the scripted expert with which it begins.
    """

    iterations: int = 11
    sizes: tuple[float, float] = (0.1, 0.065)
    segment_s: float = 2.0
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
        if self.iterations < 0 or not 0 < self.less < 1 or min(*self.sizes, self.segment_s) <= 0:
            what = "iterations must not be negative, less lie in (0, 1), sizes and segment_s be above 0"
            raise PoiseError(what, "TrajOptConfig")
        if 0.0 not in self.steps:
            raise PoiseError(
                "one of the steps must be 0, with which a trajectory stays", "TrajOptConfig"
            )

    def size(self, iteration: int) -> float:
        """Size of the differences at an iteration, rad; it falls geometrically."""
        first, last = self.sizes
        return first * (last / first) ** min(1.0, iteration / max(1, self.iterations - 1))


@dataclass(frozen=True, eq=False)
class Trajectories:
    """One optimised trajectory per clip; row r stands where row r of the reference does.

    Attributes:
        qpos: `(F, nq)` float64.
        qvel: `(F, nv)` float64.
        target: `(F, n)` rad float32, servo targets.
        feedback: `(F, n, 2 nv)` float32, how the targets change with the deviation (`sim.difference`,
            then velocities).
        price: `(2 nv)`, what the squares of deviations cost in the optimisation.
    """

    qpos: Tensor
    qvel: Tensor
    target: Tensor
    feedback: Tensor
    price: Tensor


@dataclass(frozen=True)
class TrajOptStats:
    """What an iteration came to, over all frames.

    Attributes:
        iteration: its number, from 1.
        error_m: mean distance of the root from the reference, m.
        help_n: mean force that still helps, N.
        unhelped: share of the frames where help has ended.
        seconds: of all iterations so far.
    """

    iteration: int
    error_m: float
    help_n: float
    unhelped: float
    seconds: float
