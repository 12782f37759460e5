"""A snapshot of an environment: everything that some of its worlds are, copied."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What n worlds were, see `ImitationEnv.snapshot`.

    Attributes:
        worlds: tensors `(n, ...)` by name: physics "sim", the goal's and the plug-ins' rows, "age",
            "action", ...
        physics: width of the physics without derived fields, the first columns of "sim".
        goal: what the goal's rows point into.
        shared: what all worlds of the environment share: help, failure rates, odds, random generators;
            None where only some of its worlds were copied.
    """

    worlds: Mapping[str, Tensor]
    physics: int
    goal: Mapping[str, Tensor]
    shared: Mapping[str, Tensor] | None

    def __len__(self) -> int:
        return len(self.worlds["sim"])

    def repeated(self, count: int) -> Snapshot:
        """A snapshot of one world as one of `count` worlds."""
        many = {k: v.expand(count, *v.shape[1:]) for k, v in self.worlds.items()}
        return Snapshot(many, self.physics, self.goal, None)

    def picked(self, rows: Tensor) -> Snapshot:
        """The worlds `rows (k,)` of this snapshot, each as often as it is named."""
        return Snapshot({k: v[rows] for k, v in self.worlds.items()}, self.physics, self.goal, None)


def copied(values: Mapping[str, Tensor], rows: Tensor | None) -> dict[str, Tensor]:
    """Copies of rows `(n,)` of tensors `(N, ...)`, all for None."""
    return {k: v.clone() if rows is None else torch.index_select(v, 0, rows) for k, v in values.items()}


def written(into: Mapping[str, Tensor], values: Mapping[str, Tensor], rows: Tensor | None) -> None:
    """Writes values `(n, ...)` into rows `(n,)` of the tensors of the same names, all for None."""
    for name, value in into.items():
        if rows is None:
            value.copy_(values[name])
        else:
            value[rows] = values[name]
