"""Perceptrons with hidden layers multiplied in bfloat16: an update at half the cost."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from poise.nets.mlp import MLP
from poise.nets.progressive import ProgressiveNet

#: What may give the mean of a policy.
MeanNet = MLP | ProgressiveNet


def bfloat16_is_fast() -> bool:
    """Whether this processor multiplies bfloat16 matrices itself (else they are slower than float32)."""
    return bool(torch.cpu.get_capabilities().get("avx512_bf16", False))


def half_forward(net: MeanNet, x: Tensor) -> Tensor:
    """`net(x)` with hidden layers, forward and backward, in bfloat16 and the last layer in float32.

    Values and gradients differ from float32's by about 0.4 % of their size, far less than one minibatch
    differs from the next. Weights stay float32, and so do their gradients as the optimiser sees them.

    Args:
        x: `(N, num_in)` inputs, float32 or already bfloat16.
    """
    x = x.bfloat16()
    if isinstance(net, ProgressiveNet):
        return net.forward(x)
    for layer in list(net.layers)[:-1]:
        if isinstance(layer, nn.Linear):
            x = functional.linear(x, layer.weight.bfloat16(), layer.bias.bfloat16())
        else:
            x = layer(x)
    return net.last(x.float())
