"""Perceptrons: shapes, first weights, names."""

import pytest
import torch

from poise.learn.networks import ACTIVATIONS, MLP
from refusals import refused


def make(seed: int = 0, **options) -> MLP:
    return MLP(5, (8, 6), 3, generator=torch.Generator().manual_seed(seed), **options)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_forward_equals_the_layers_by_hand(activation):
    net = make(activation=activation)
    x = torch.randn(2, 7, 5, generator=torch.Generator().manual_seed(1))
    linear = [m for m in net.layers if isinstance(m, torch.nn.Linear)]
    act = ACTIVATIONS[activation]()
    y = x
    for i, layer in enumerate(linear):
        y = y @ layer.weight.T + layer.bias
        y = act(y) if i + 1 < len(linear) else y
    assert net(x).shape == (2, 7, 3)
    torch.testing.assert_close(net(x), y)


def test_the_last_layer_starts_small_without_a_bias():
    big, small = make(), make(last_scale=0.1)
    torch.testing.assert_close(small.last.weight, big.last.weight * 0.1)
    assert bool((big.last.bias == 0).all())
    assert float(big.last.weight.detach().abs().max()) <= 6**-0.5


def test_the_same_seed_gives_the_same_weights_and_leaves_the_global_generator_alone():
    before = torch.get_rng_state()
    a, b, c = make(3), make(3), make(4)
    assert torch.equal(a.last.weight, b.last.weight)
    assert not torch.equal(a.last.weight, c.last.weight)
    assert torch.equal(before, torch.get_rng_state())


def test_errors_name_what_exists():
    with refused("unknown-choice", says="relu"):
        make(activation="rellu")
    with refused("out-of-range"):
        MLP(0, (4,), 1, generator=torch.Generator())


@pytest.mark.parametrize("activation", ["relu", "silu"])
@pytest.mark.parametrize("hidden", [(), (64,), (64, 32)])
def test_in_bfloat16_values_and_gradients_differ_by_rounding_alone(activation, hidden):
    rng = torch.Generator().manual_seed(0)
    net = MLP(20, hidden, 5, activation, generator=rng)
    x, goal = torch.randn(256, 20, generator=rng), torch.randn(256, 5, generator=rng)
    outs, grads = [], []
    for out in (net(x), net(x.bfloat16())):
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
