"""What looks at a scene's own figures while it is played."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from poise.env import ImitationEnv
from poise.env.events import ScenePart


class Meter(Protocol):
    """Looks at the environments of a scene, and has figures at the end: means over the episodes."""

    words: Mapping[str, str]
    """What the figures are, by their keys."""

    def begin(self, env: ImitationEnv) -> None:
        """Looks at an environment from now on."""
        ...

    def see(self, env: ImitationEnv, step: int) -> None:
        """Control step `step` has been made; 0 is before the first one."""
        ...

    def figures(self) -> dict[str, float]:
        """What was seen."""
        ...


def part_of(env: ImitationEnv) -> ScenePart:
    """An environment's part in its scene."""
    part = env.plugin(ScenePart)
    assert part is not None
    return part
