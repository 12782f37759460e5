"""Which equations of the paper are corrected, and why."""

from __future__ import annotations

import math
from dataclasses import dataclass

from poise.errors import PoiseError

#: Every correction with what is wrong in the paper. Two more need no switch: the doubled symbols in the
#: denominators of Eqs. 11 and 12 are misprints of norms, and elbows bend to -z on the left and +z on the
#: right (Eqs. 10 and 13), so that ranges must be mirrored, which generated humanoids do.
CORRECTIONS: dict[str, str] = {
    "knee_subscripts": "Eq. 20 builds the left knee's parent from the child's axes; Eq. 23 does not",
    "square_ankle": "Eqs. 21, 24: shin and foot are not square, so Eq. 6 reads 30 degrees as 26.6",
    "hold_bend": "Eqs. 5, 10, 13, 20, 23: a straight limb has no bend axis, and beyond it flips",
    "spine_twist": "Eqs. 16-18: a straight spine has no bend axis, and it flips with the bend",
    "trunk_fit": "Eqs. 16, 18: cross products that vanish or point elsewhere on other skeletons",
    "thigh_twist": "Eqs. 19, 22: twist from the line of the hips leaves the thigh's to the knee",
    "branches": "Eq. 7 adds one turn once, and keeps flips between the two Euler branches",
}


@dataclass(frozen=True)
class IkConfig:
    """How the paper's equations are read.

    faithful: "corrected" or "paper"; what every correction below (see `CORRECTIONS`) takes that is None.
    straight: rad, the bend of a limb below which its bend plane is held. hold_frames: over how long.
    """

    faithful: str = "corrected"
    knee_subscripts: bool | None = None
    square_ankle: bool | None = None
    hold_bend: bool | None = None
    spine_twist: bool | None = None
    trunk_fit: bool | None = None
    thigh_twist: bool | None = None
    branches: bool | None = None
    straight: float = math.radians(3.0)
    hold_frames: float = 5.0

    def __post_init__(self) -> None:
        if self.faithful not in ("corrected", "paper"):
            raise PoiseError(f"faithful must be corrected or paper, got '{self.faithful}'")
        if not (0.0 < self.straight < math.pi / 2 and self.hold_frames > 0.0):
            raise PoiseError(
                "straight must lie between 0 and pi / 2 and hold_frames above 0, got "
                f"{self.straight:g} and {self.hold_frames:g}"
            )

    def on(self, correction: str) -> bool:
        """Whether one of `CORRECTIONS` is made."""
        chosen = getattr(self, correction)
        return self.faithful == "corrected" if chosen is None else chosen

    @property
    def square(self) -> bool:
        """Whether all frames are square, so that Eq. 6 changes nothing."""
        return all(self.on(c) for c in CORRECTIONS if c != "branches")
