"""Settings of live motion."""

from __future__ import annotations

from dataclasses import dataclass

from poise.errors import PoiseError
from poise.settings import validate


@dataclass(frozen=True)
class LiveConfig:
    """How live motion is followed.

    Attributes:
        characters: in one world.
        buffer_s: s, 0 to 0.4: half of it, and 0.05 s at least, evens out how packets come; the rest is
            known ahead. With 0 the goal is extrapolated.
        lookahead: how many characters look ahead before they act, the first ones.
        noise: 0 to 1, what is added to goals as a video estimator errs: 0.1 rad and 30 mm for 1,
            which wander within 0.3 s.
        seed: of the noise and of lookahead.
    """

    characters: int = 1
    buffer_s: float = 0.1
    lookahead: int = 0
    noise: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        validate(self)
        if not 1 <= self.characters <= 16:
            raise PoiseError(f"characters must lie in 1 to 16, got {self.characters}", "LiveConfig")
        if not 0 <= self.buffer_s <= 0.4:
            raise PoiseError(f"buffer_s must lie in 0 to 0.4 s, got {self.buffer_s:g}", "LiveConfig")
        if not 0 <= self.lookahead <= self.characters:
            what = f"lookahead must lie in 0 to {self.characters} characters, got {self.lookahead}"
            raise PoiseError(what, "LiveConfig")
        if not 0 <= self.noise <= 1:
            raise PoiseError(f"noise must lie in 0 to 1, got {self.noise:g}", "LiveConfig")
