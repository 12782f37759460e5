"""Diagonal Gaussians against torch.distributions."""

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from poise.learn.networks import MLP, GaussianPolicy, gaussian_entropy, gaussian_kl, gaussian_log_prob
from refusals import refused

G = torch.Generator().manual_seed(0)
MEAN, OTHER, X = (torch.randn(4, 6, 5, generator=G, dtype=torch.float64) for _ in range(3))
LOG_STD, OTHER_LOG_STD = (torch.randn(5, generator=G, dtype=torch.float64) for _ in range(2))
TWIN = Independent(Normal(MEAN, LOG_STD.exp()), 1)


def test_log_prob_entropy_and_kl_equal_torch_distributions():
    torch.testing.assert_close(gaussian_log_prob(X, MEAN, LOG_STD), TWIN.log_prob(X))
    torch.testing.assert_close(gaussian_entropy(LOG_STD).expand(4, 6), TWIN.entropy())
    other = Independent(Normal(OTHER, OTHER_LOG_STD.exp()), 1)
    torch.testing.assert_close(
        gaussian_kl(MEAN, LOG_STD, OTHER, OTHER_LOG_STD), kl_divergence(TWIN, other)
    )


def test_kl_of_a_shift_by_hand():
    # KL = (0.1 / 0.1)^2 / 2 in each of 2 dimensions.
    mean, log_std = torch.zeros(2), torch.full((2,), 0.1).log()
    assert float(gaussian_kl(mean, log_std, mean + 0.1, log_std)) == pytest.approx(1.0, rel=1e-5)


def make(std=0.1, learn_std: bool = False) -> GaussianPolicy:
    mean = MLP(3, (8,), 2, last_scale=0.1, generator=torch.Generator().manual_seed(0))
    return GaussianPolicy(mean, std, learn_std)


def test_samples_have_the_stated_deviation_and_follow_the_seed():
    policy, obs = make((0.5, 2.0)), torch.zeros(100_000, 3)
    action, mean = policy.act(obs, torch.Generator().manual_seed(1)), policy.act(obs)
    torch.testing.assert_close((action - mean).std(0), torch.tensor([0.5, 2.0]), rtol=0.01, atol=0)
    assert torch.equal(action, policy.act(obs, torch.Generator().manual_seed(1)))
    assert torch.equal(mean, policy(obs))


def test_a_fixed_deviation_has_no_gradient():
    assert not make().log_std.requires_grad
    policy = make(learn_std=True)
    gaussian_entropy(policy.log_std).backward()
    assert policy.log_std.grad is not None
    torch.testing.assert_close(policy.log_std.grad, torch.ones(2))


@pytest.mark.parametrize("std", [0.0, (0.1, -1.0), (0.1, 0.1, 0.1)])
def test_a_wrong_deviation_is_refused(std):
    with refused("out-of-range", says="2"):
        make(std)
