"""Columns, lateral connections and the product of Gaussians, against naive twins."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import norm as normal

from poise.learn.composer import Composer, product_of_gaussians
from poise.learn.networks import ProgressiveNet, gaussian_log_prob
from refusals import refused


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def columns(count: int, lateral: bool, start: str = "random", hidden=(7, 6)) -> ProgressiveNet:
    net = ProgressiveNet(5, hidden, 3, "relu", lateral, generator=rng())
    for k in range(1, count):
        net.add(start, rng(k))  # type: ignore[arg-type]
    return net


def twin(net: ProgressiveNet, x: torch.Tensor) -> list[torch.Tensor]:
    """Rusu's Eq. 1, matrix by matrix."""
    entered: list[list[torch.Tensor]] = []
    for k in range(len(net)):
        layers = [m for m in net.column(k).layers if isinstance(m, torch.nn.Linear)]
        h, own = x, [x]
        for i, layer in enumerate(layers):
            z = h @ layer.weight.T + layer.bias
            if i and net.lateral:
                for j in range(k):
                    z = z + entered[j][i] @ net.laterals[k][j][i - 1].weight.T  # type: ignore[index]
            h = z if i == len(layers) - 1 else z.clamp_min(0)
            own.append(h)
        entered.append(own)
    return [own[-1] for own in entered]


@pytest.mark.parametrize("lateral", [False, True])
def test_columns_are_those_of_the_equation(lateral):
    net, x = columns(3, lateral), torch.randn(9, 5, generator=rng(7))
    want = twin(net, x)
    torch.testing.assert_close(net(x), want[-1])
    torch.testing.assert_close(net.all(x), torch.stack(want, 1))
    assert net.all(x).shape == (9, 3, 3)
    half = net(x.bfloat16())
    assert half.dtype == torch.float32
    torch.testing.assert_close(half, want[-1], rtol=0.03, atol=0.02)
    kept = net.copy()
    kept.keep(2)
    torch.testing.assert_close(kept(x), want[1])


@pytest.mark.parametrize("lateral", [False, True])
def test_a_copied_column_is_at_first_the_same_function(lateral):
    net, x = columns(3, lateral), torch.randn(9, 5, generator=rng(7))
    want = net.all(x)
    net.add("copy", rng(9))
    torch.testing.assert_close(net(x), want[:, -1], rtol=0, atol=1e-6)
    torch.testing.assert_close(net.all(x)[:, :3], want, rtol=0, atol=0)


def test_only_the_last_column_and_its_laterals_learn():
    net, x = columns(3, True), torch.randn(9, 5, generator=rng(7))
    net(x).square().sum().backward()
    for name, p in net.named_parameters():
        own = name.startswith(("columns.2", "laterals.2"))
        assert p.requires_grad == own, name
        assert (p.grad is not None and bool(p.grad.any())) == own, name
    # Zero laterals of a copy still learn.
    net.add("copy", rng())
    net(x).square().sum().backward()
    assert all(bool(p.grad.any()) for p in net.laterals[3].parameters())  # type: ignore[union-attr]


def test_new_columns_draw_nothing_from_the_global_generator():
    torch.manual_seed(1)
    want = torch.rand(1)
    torch.manual_seed(1)
    columns(3, True)
    assert torch.equal(torch.rand(1), want)


def test_columns_that_cannot_be_are_refused():
    net = columns(2, False)
    with refused("unknown-choice"):
        net.add("twin", rng())  # type: ignore[arg-type]
    with refused("out-of-range", says=("3", "2")):
        net.keep(3)
    with refused("settings-conflict"):
        ProgressiveNet(2, (), 1, lateral=True, generator=rng())


def test_the_product_of_gaussians_is_a_gaussian_by_brute_force():
    weight = torch.tensor([[0.3, 1.2, 0.0], [2.0, 0.5, 0.7]], dtype=torch.float64)
    mean = torch.randn(2, 3, 2, generator=rng(1), dtype=torch.float64)
    std = torch.tensor([[0.5, 1.0], [0.8, 0.3], [1.5, 0.6]], dtype=torch.float64)
    got_mean, got_log = product_of_gaussians(weight, mean, std.log())
    grid = np.linspace(-12, 12, 200_001)
    for n in range(2):
        for j in range(2):
            logs = [
                float(weight[n, k]) * normal.logpdf(grid, float(mean[n, k, j]), float(std[k, j]))
                for k in range(3)
            ]
            density = np.exp(np.sum(logs, 0))
            density /= density.sum()
            mu = (density * grid).sum()
            sigma = np.sqrt((density * (grid - mu) ** 2).sum())
            assert float(got_mean[n, j]) == pytest.approx(mu, abs=1e-6)
            assert float(got_log[n, j].exp()) == pytest.approx(sigma, rel=1e-6)
    # One primitive alone is itself.
    alone, log_std = product_of_gaussians(torch.ones(1, 1), mean[:1, :1].float(), std[:1].float().log())
    torch.testing.assert_close(alone, mean[:1, 0].float())
    torch.testing.assert_close(log_std, std[:1].float().log())


def composer(**options) -> Composer:
    net = columns(3, False)
    return Composer(net, torch.full((3, 3), -1.0), (8,), generator=rng(4), **options)


@pytest.mark.parametrize("weights", ["softmax", "softplus", "relu", "silu"])
def test_at_first_all_primitives_weigh_the_same(weights):
    policy, obs = composer(combine="means", weights=weights), torch.zeros(4, 5)
    with torch.no_grad():
        policy.mean.last.weight.zero_()
    torch.testing.assert_close(policy.weight(obs), torch.full((4, 3), 1 / 3), rtol=1e-4, atol=1e-5)


def test_a_product_draws_actions_and_means_draw_weights():
    obs = torch.randn(6, 5, generator=rng(2))
    product = composer(weights="softplus")
    mean, log_std = product.distribution(obs, product.context(obs))
    w, mu = product.weight(obs), product.primitives.all(obs)
    # All sigmas are e^-1, so the mean is the weighted one and sigma^2 = e^-2 / sum w.
    torch.testing.assert_close(mean, (w.unsqueeze(-1) * mu).sum(1) / w.sum(1, keepdim=True))
    torch.testing.assert_close(log_std, (-1 - 0.5 * w.sum(1).log()).unsqueeze(1).expand(6, 3))
    assert product.num_drawn == product.num_actions == 3
    torch.testing.assert_close(product.act(obs), mean)
    torch.testing.assert_close(product.distribution(obs)[0], mean)
    action = torch.randn(6, 3, generator=rng(3))
    one = torch.distributions.Normal(mean, log_std.exp()).log_prob(action).sum(-1)
    torch.testing.assert_close(gaussian_log_prob(action, mean, log_std), one)

    means = composer(combine="means", weights="relu", std=0.2)
    assert means.num_drawn == 3 and means.num_actions == 3
    drawn, context = torch.rand(6, 3, generator=rng(3)), means.context(obs)
    want = (drawn.unsqueeze(-1) * means.primitives.all(obs)).sum(1)
    torch.testing.assert_close(means.drive(drawn, context), want)
    noisy = means.act(obs, rng(5))
    noise = torch.randn(6, 3, generator=rng(5)) * 0.2
    torch.testing.assert_close(noisy, means.drive(means.weight(obs) + noise, context))


def test_frozen_primitives_get_no_gradient_and_joint_ones_do():
    obs = torch.randn(6, 5, generator=rng(2))
    for joint in (False, True):
        policy = composer(joint=joint)
        context = policy.context(obs)
        assert (context is None) == joint
        mean, log_std = policy.distribution(obs, context)
        (mean.square().sum() + log_std.sum()).backward()
        assert all((p.grad is not None) == joint for p in policy.primitives.parameters())
        assert all(p.grad is not None for p in policy.mean.parameters())


def test_composers_that_cannot_be_are_refused():
    for bad, words in (
        ({"combine": "sum"}, ("unknown-choice", "sum")),
        ({"weights": "silu"}, ("unknown-choice", "silu")),
        ({"combine": "means", "joint": True}, ("settings-conflict",)),
    ):
        with refused(*words):
            composer(**bad)
    with refused("wrong-shape", says="(3, 3)"):
        Composer(columns(3, False), torch.zeros(2, 3), generator=rng())
