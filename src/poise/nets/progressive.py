"""Progressive neural networks (Rusu et al. 2016): columns of which only the last one learns."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, cast

import torch
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.nets.mlp import MLP, bare_linear, product

Start = Literal["copy", "random"]


class ProgressiveNet(nn.Module):
    """K perceptrons ("columns", PHC's primitives) of the same sizes; all but the last are frozen.

    Column k has layers i = 1 .. L with the activation f (the last layer is linear):

        h_i^k = f( W_i^k h_(i-1)^k + b_i^k + sum_(j<k) U_i^(k:j) h_(i-1)^j ),   i > 1     (Rusu, Eq. 1)

    PHC's paper describes the lateral connections U; its code has none (`lateral=False`) and starts a
    column as a copy of the one before it, which the paper calls weight sharing.

    Args:
        num_in, hidden, num_out, activation: sizes of each column, as of an `MLP`.
        lateral: whether there are the matrices U.
        generator: source of the first column's weights.
    """

    log_std: Tensor

    def __init__(
        self,
        num_in: int,
        hidden: Sequence[int],
        num_out: int,
        activation: str = "relu",
        lateral: bool = False,
        *,
        generator: torch.Generator,
    ):
        super().__init__()
        self.num_in, self.num_out, self.lateral = num_in, num_out, lateral
        self.hidden, self.activation = tuple(hidden), activation
        if lateral and not self.hidden:
            raise PoiseError("lateral connections need at least one hidden layer")
        # Row k: log sigma with which the frozen column k was trained; the policy holds the last one's.
        self.register_buffer("log_std", torch.zeros(0, num_out))
        self.columns = nn.ModuleList()
        # laterals[k][j] holds the layers U_i^(k:j) of i = 2 .. L.
        self.laterals = nn.ModuleList()
        self._append(generator)

    def __len__(self) -> int:
        """K, the number of columns."""
        return len(self.columns)

    @property
    def last(self) -> nn.Linear:
        """The output layer of the column that learns."""
        return self.column(len(self) - 1).last

    def column(self, k: int) -> MLP:
        """Column k's own layers."""
        return cast(MLP, self.columns[k])

    def add(self, start: Start, generator: torch.Generator) -> None:
        """Freezes all columns and appends one that learns.

        Args:
            start: "copy" makes it the same function as the last column; "random" draws new weights, the
                lateral ones too.
            generator: source of random weights.
        """
        if start not in ("copy", "random"):
            raise PoiseError(f"a column cannot start as '{start}'", hint="Use copy or random")
        last = len(self) - 1
        self.requires_grad_(False)
        self._append(generator)
        if start == "random":
            return
        self.column(-1).load_state_dict(self.column(last).state_dict())
        for lateral, other in zip(self._laterals(last + 1), self._laterals(last), strict=False):
            lateral.load_state_dict(other.state_dict())
        if self.lateral:
            for p in self._laterals(last + 1)[last].parameters():
                nn.init.zeros_(p)

    def copy(self) -> ProgressiveNet:
        """An independent copy."""
        return copy.deepcopy(self)

    def keep(self, count: int) -> None:
        """Drops the columns after the first `count`; the last one left is as frozen as it was."""
        if not 1 <= count <= len(self):
            raise PoiseError(f"{count} of {len(self)} columns cannot be kept")
        self.columns, self.laterals = self.columns[:count], self.laterals[:count]
        self.log_std = self.log_std[:count].clone()

    def forward(self, x: Tensor) -> Tensor:
        """The last column's output, `(..., num_in)` to `(..., num_out)`.

        Inputs in bfloat16 pass the hidden layers in bfloat16, as in an `MLP`; outputs are float32.
        """
        if not self.lateral or len(self) == 1:
            return self.column(-1).forward(x)
        return self._outputs(x)[-1]

    def all(self, x: Tensor) -> Tensor:
        """The outputs of all columns, `(..., num_in)` to `(..., K, num_out)`."""
        return torch.stack(self._outputs(x), -2)

    def _outputs(self, x: Tensor) -> list[Tensor]:
        passes: list[list[Tensor]] = []
        for k in range(len(self)):
            passes.append(self._run(k, x, passes))
        return [layers[-1] for layers in passes]

    def _run(self, k: int, x: Tensor, before: Sequence[Sequence[Tensor]]) -> list[Tensor]:
        """What enters each layer of column k, and its output; `before` holds that of earlier columns."""
        layers = list(self.column(k).layers)
        linear, activation = layers[::2], layers[1::2]
        entered = [x]
        for i, layer in enumerate(linear):
            last = i == len(linear) - 1
            h = product(layer, entered[-1], last)
            if i and self.lateral:
                for lateral, other in zip(self._laterals(k), before, strict=True):
                    h = h + product(lateral[i - 1], other[i], last)
            entered.append(h if last else activation[i](h))
        return entered

    def _laterals(self, k: int) -> list[nn.ModuleList]:
        return [cast(nn.ModuleList, part) for part in cast(nn.ModuleList, self.laterals[k])]

    def _append(self, generator: torch.Generator) -> None:
        sizes = (self.num_in, self.hidden, self.num_out, self.activation)
        self.columns.append(MLP(*sizes, last_scale=0.1, generator=generator))
        device = self.column(0).last.weight.device
        widths = [*self.hidden, self.num_out]
        earlier = nn.ModuleList()
        for _ in range(len(self) - 1 if self.lateral else 0):
            matrices = [bare_linear(a, b, bias=False) for a, b in pairwise(widths)]
            for i, matrix in enumerate(matrices):
                # As of the column's own layers, with a small last one.
                bound = matrix.in_features**-0.5 * (0.1 if i == len(matrices) - 1 else 1.0)
                with torch.no_grad():
                    matrix.weight.uniform_(-bound, bound, generator=generator)
            earlier.append(nn.ModuleList(matrices))
        self.laterals.append(earlier)
        self.log_std = torch.cat((self.log_std, self.log_std.new_zeros(1, self.num_out)))
        self.to(device)
