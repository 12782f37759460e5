"""What happens in the worlds of a scene: when episodes begin, at intervals, on conditions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from poise.sim import SceneSim

#: Worlds `(N,)` bool in which something is so, such as a hand near a knob.
Condition = Callable[[SceneSim], Tensor]


class Event(Protocol):
    """The settings of an event, given to `InScene.events`."""

    def __call__(self, sim: SceneSim, control_hz: float) -> Happening:
        """The event in the worlds of a scene; a PoiseError for what is not in it."""
        ...


class Happening:
    """An event in N worlds; every hook may be left as it is."""

    def begin(self, worlds: Tensor) -> None:
        """Episodes of all characters begin in `worlds (n,)`."""

    def before(self) -> None:
        """A control step is about to be made."""

    def after(self) -> None:
        """A control step has been made."""

    def rows(self) -> dict[str, Tensor]:
        """What it knows of each world, `(N, ...)` by name: tensors that a snapshot copies in place."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """What all worlds share, such as a generator's state."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Goes on from `state()`."""


class Drawn(Happening):
    """An event with a generator of its own."""

    def __init__(self, seed: int):
        self.rng = torch.Generator().manual_seed(seed)

    def between(self, low: float, high: float, *shape: int) -> Tensor:
        """Numbers drawn evenly, float64 on the CPU."""
        return low + (high - low) * torch.rand(*shape, generator=self.rng, dtype=torch.float64)

    def state(self) -> dict[str, Tensor]:
        return {"rng": self.rng.get_state()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.rng.set_state(state["rng"])
