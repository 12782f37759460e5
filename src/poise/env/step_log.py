"""The log of one control step, worked out only where it is read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from poise.control import Wrench


class StepLog(Mapping[str, float]):
    """Means over the worlds: "reward/NAME" of every term, "imitation", the help in N and N m,
    the limit of its force in N (`limit_n`, a number or `(N,)`), and whatever `more` there is.

    All of them come by one pass and one wait for the numbers, at the first that is read.
    """

    def __init__(
        self,
        terms: Mapping[str, Tensor],
        imitation: Tensor,
        wrench: Wrench | None,
        limit_n: float | Tensor,
        more: Mapping[str, Tensor] | None = None,
    ):
        self._parts = terms, imitation, wrench, limit_n, more or {}
        self._values: dict[str, float] | None = None

    def _read(self) -> dict[str, float]:
        if self._values is None:
            terms, imitation, wrench, limit_n, more = self._parts
            rows = {**{f"reward/{name}": value for name, value in terms.items()}, "imitation": imitation}
            if wrench is not None:
                rows["help/force_n"] = wrench.force.norm(dim=-1).sum(-1)
                rows["help/torque_nm"] = wrench.torque.norm(dim=-1).sum(-1)
            rows.update(more)
            if wrench is not None and isinstance(limit_n, Tensor):
                rows["help/limit_n"] = limit_n
            means = torch.stack(list(rows.values())).mean(-1).tolist()
            self._values = dict(zip(rows, means, strict=True))
            if wrench is not None and not isinstance(limit_n, Tensor):
                self._values["help/limit_n"] = limit_n
        return self._values

    def __getitem__(self, name: str) -> float:
        return self._read()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._read())

    def __len__(self) -> int:
        return len(self._read())
