"""Hidden layers in bfloat16: nearly the same values, nearly the same gradients."""

from __future__ import annotations

import pytest
import torch

from poise.nets import MLP, half_forward


@pytest.mark.parametrize("activation", ["relu", "silu"])
@pytest.mark.parametrize("hidden", [(), (64,), (64, 32)])
def test_values_and_gradients_differ_by_rounding_alone(activation, hidden):
    rng = torch.Generator().manual_seed(0)
    net = MLP(20, hidden, 5, activation, generator=rng)
    x, goal = torch.randn(256, 20, generator=rng), torch.randn(256, 5, generator=rng)
    outs, grads = [], []
    for out in (net(x), half_forward(net, x)):
        assert out.dtype == torch.float32
        net.zero_grad()
        (out - goal).square().mean().backward()
        outs.append(out.detach())
        grads.append([p.grad.clone() for p in net.parameters() if p.grad is not None])
    assert float((outs[0] - outs[1]).norm() / outs[0].norm()) < 0.01
    assert len(grads[0]) == len(grads[1]) == 2 * (len(hidden) + 1)
    for a, b in zip(*grads, strict=True):
        assert b.dtype == torch.float32
        assert float((a - b).norm() / a.norm()) < 0.06
