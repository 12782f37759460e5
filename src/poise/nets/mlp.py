"""The multi-layer perceptron."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from poise.errors import PoiseError, did_you_mean

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "relu": nn.ReLU,
    "silu": nn.SiLU,
    "gelu": nn.GELU,
    "elu": nn.ELU,
    "tanh": nn.Tanh,
}


def _activation(name: str) -> nn.Module:
    # In place, ReLU spares the largest arrays of an update a copy (a twentieth of its time).
    return nn.ReLU(inplace=True) if name == "relu" else ACTIVATIONS[name]()


def bare_linear(num_in: int, num_out: int, bias: bool = True) -> nn.Linear:
    """A layer with weights that are yet to be filled; nothing is drawn from the global generator.

    `nn.utils.skip_init` does the same by way of meta tensors, for which torch imports SymPy: half a
    second for a program that only runs a policy.
    """
    with torch.random.fork_rng(devices=[]):
        return nn.Linear(num_in, num_out, bias)


def bfloat16_is_fast() -> bool:
    """Whether this processor multiplies bfloat16 matrices in tiles (AMX). With the instructions of
    AVX-512 alone an update takes 1.7 times as long as in float32, and without either still longer."""
    return bool(torch.cpu.get_capabilities().get("amx_bf16", False))


def product(layer: nn.Module, x: Tensor, last: bool = False) -> Tensor:
    """A linear layer in the arithmetic of `x`; in float32 instead of bfloat16 if it is the `last` one.

    In bfloat16 values and gradients differ from float32's by about 0.4 % of their size, far less than
    one minibatch differs from the next. Weights stay float32, and so do their gradients.
    """
    assert isinstance(layer, nn.Linear)
    if last or x.dtype != torch.bfloat16:
        # The layer's own `forward`, since a module's call costs more than a layer of one character.
        return layer.forward(x.float() if x.dtype == torch.bfloat16 else x)
    bias = None if layer.bias is None else layer.bias.to(x.dtype)
    return functional.linear(x, layer.weight.to(x.dtype), bias)


class MLP(nn.Module):
    """Linear layers with an activation between them; the last layer is linear.

    Args:
        num_in, num_out: widths of the input and of the output.
        hidden: widths of the hidden layers; none gives a linear map.
        activation: relu, silu, gelu, elu or tanh.
        last_scale: the output layer's weights are multiplied by it and its bias is 0, so that a
            small value starts the network near the zero function.
        generator: source of the first weights, U(-1/sqrt(num_in), 1/sqrt(num_in)) per layer.
    """

    def __init__(
        self,
        num_in: int,
        hidden: Sequence[int],
        num_out: int,
        activation: str = "relu",
        last_scale: float = 1.0,
        *,
        generator: torch.Generator,
    ):
        super().__init__()
        if activation not in ACTIVATIONS:
            raise PoiseError(
                f"there is no activation '{activation}'",
                hint=did_you_mean(activation, list(ACTIVATIONS)),
            )
        sizes = [num_in, *hidden, num_out]
        if min(sizes) < 1:
            raise PoiseError(f"every layer needs at least 1 unit, got the sizes {sizes}")
        layers: list[nn.Module] = []
        for i, (a, b) in enumerate(pairwise(sizes)):
            linear = bare_linear(a, b)
            bound = a**-0.5
            with torch.no_grad():
                linear.weight.uniform_(-bound, bound, generator=generator)
                linear.bias.uniform_(-bound, bound, generator=generator)
            layers += [linear] if i == 0 else [_activation(activation), linear]
        self.layers = nn.Sequential(*layers)
        self.num_in, self.num_out = num_in, num_out
        with torch.no_grad():
            self.last.weight.mul_(last_scale)
            self.last.bias.zero_()

    @property
    def last(self) -> nn.Linear:
        """The output layer."""
        layer = self.layers[-1]
        assert isinstance(layer, nn.Linear)
        return layer

    def forward(self, x: Tensor) -> Tensor:
        """`(..., num_in)` to `(..., num_out)`.

        Inputs in bfloat16 pass the hidden layers in bfloat16, forward and backward, at half the cost of
        an update; outputs are float32.
        """
        *hidden, last = self.layers
        for layer in hidden:
            x = product(layer, x) if isinstance(layer, nn.Linear) else layer.forward(x)
        return product(last, x, last=True)
