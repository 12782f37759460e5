"""How much help is left: schedules that take the residual force away while a policy learns.

The scale `s` in [0, 1] multiplies the limits of a `Residual`. A schedule is asked at fixed intervals
and sees how many control steps each world has made and how many episodes lately succeeded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from poise.errors import PoiseError


class HelpSchedule(Protocol):
    """When the help becomes less, and when more."""

    @property
    def every(self) -> int:
        """Control steps between two decisions."""
        ...

    def scale(self, scale: float, steps: int, success: float) -> float:
        """The scale from now on.

        Args:
            scale: the present one.
            steps: control steps that each world has made.
            success: the share of recent episodes that did not end by failure, in [0, 1]; NaN when
                none has ended yet.
        """
        ...


@dataclass(frozen=True)
class LinearHelp:
    """Skeleton2Humanoid's Eq. 9: constant, then falling steadily, then constant.

    S_r = S_init - alpha (i - i_start) between i_start and i_end. The paper's iterations are control
    steps here; its S_init 220, alpha 0.1, i_start 100, i_end 1300 of 50,000 samples end at scale 0.45.

    Attributes:
        start: control steps of each environment at which the scale begins to fall.
        stop: control steps of each environment at which it has fallen.
        final: the scale at and after `stop`.
        every: control steps between two decisions.
    """

    start: int
    stop: int
    final: float = 0.0
    every: int = 16

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.stop:
            raise PoiseError(
                f"help must fall from one step to a later one, got {self.start}, {self.stop}"
            )
        _check_final(self.final)

    def scale(self, scale: float, steps: int, success: float) -> float:
        """A function of the steps alone."""
        along = min(1.0, max(0.0, (steps - self.start) / (self.stop - self.start)))
        return 1.0 - along * (1.0 - self.final)


@dataclass(frozen=True)
class SuccessHelp:
    """Less help while episodes succeed, more when they fail.

    Exploration fails many episodes that the policy itself would not: where the policy succeeds from
    97 % of the starts, training shows 0.65.

    Attributes:
        lower_at: success from which the scale is multiplied by `factor`.
        raise_at: success under which the scale is divided by it.
        factor: below 1.
        smallest: under this scale the help ends (it becomes `final`); a policy that then fails gets
            this much back.
        final: never less than this.
        every: control steps between two decisions.
    """

    lower_at: float = 0.5
    raise_at: float = 0.3
    factor: float = 0.98
    smallest: float = 0.05
    final: float = 0.0
    every: int = 16

    def __post_init__(self) -> None:
        if not 0 < self.raise_at < self.lower_at <= 1:
            raise PoiseError(f"success must satisfy 0 < raise_at {self.raise_at} < lower_at "
                             f"{self.lower_at} <= 1")  # fmt: skip
        if not (0 < self.factor < 1 and 0 < self.smallest <= 1):
            raise PoiseError(
                f"factor and smallest must lie in (0, 1), got {self.factor}, {self.smallest}"
            )
        _check_final(self.final)

    def scale(self, scale: float, steps: int, success: float) -> float:
        """One notch down, up, or none."""
        if success >= self.lower_at:
            less = scale * self.factor
            return max(self.final, less if less >= self.smallest else 0.0)
        if success < self.raise_at:
            return min(1.0, max(scale, self.smallest) / self.factor)
        return scale


def _check_final(final: float) -> None:
    if not 0 <= final <= 1:
        raise PoiseError(f"the last scale of the help must lie in [0, 1], got {final}")
