"""Where characters go: of several futures that a kinematic policy proposes, which is done next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.errors import PoiseError

#: Distance (m) at which a target is reached.
REACHED = 0.5
#: Most distance (m) of a target from the one before it.
FAR = 10_000.0
#: Distance (m) that characters are to keep, with what a simulation is off; cost of a metre too near.
APART, NEAR_COST = 0.7, 100.0
#: Futures that are proposed where one is chosen: to get somewhere, and to keep apart alone.
PROPOSALS, FEW = 240, 24


@dataclass(frozen=True)
class Steering:
    """Targets one after another, and distance from each other.

    Attributes:
        targets: x and y in m, in the order in which they are to be reached; after the last one
            characters go where they like.
        apart: whether characters of one world keep away from each other.
    """

    targets: tuple[tuple[float, float], ...] = ()
    apart: bool = False

    def __post_init__(self) -> None:
        for x, y in self.targets:
            if not (abs(x) <= FAR and abs(y) <= FAR):
                raise PoiseError(f"a target lies within {FAR:g} m, got {x:g},{y:g}")

    @property
    def chooses(self) -> bool:
        """Whether one of several futures is to be chosen at all."""
        return bool(self.targets) or self.apart

    @property
    def proposals(self) -> int:
        """How many futures one is chosen from."""
        return PROPOSALS if self.targets else FEW

    def target(self, reached: int) -> Tensor | None:
        """The next one `(2)` m after so many; None after the last."""
        return torch.tensor(self.targets[reached]).double() if reached < len(self.targets) else None


def cost_of(futures: Tensor, target: Tensor | None, others: Sequence[Tensor]) -> Tensor:
    """What futures cost, `(K)`.

    Args:
        futures: `(K, f, 2)` m, where the root goes in each.
        target: `(2)` m; None for none.
        others: `(f, 2)` m, where each of the other characters goes meanwhile.
    """
    cost = torch.zeros(len(futures)).to(futures)
    if target is not None:
        off = (futures - target).norm(dim=-1)
        # Halfway counts as well, so that it does not go round about.
        cost = torch.minimum(0.5 * (off[:, -1] + off[:, off.shape[1] // 2]), off.amin(-1) + REACHED)
    for other in others:
        near = (APART - (futures - other).norm(dim=-1)).clamp_min(0.0)
        cost = cost + NEAR_COST * near.square().mean(-1)
    return cost
