"""Advantages against numbers worked out by hand and against the definition."""

import torch

from poise.learn import gae


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def flags(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool)[:, None]


R, V, NEXT = column(1, 2, 3), column(0.5, 1, 1.5), column(1, 1.5, 2)
NONE = flags(0, 0, 0)


def check(terminated, truncated, want, next_value=NEXT):
    advantage, returns = gae(R, V, next_value, terminated, truncated, gamma=0.5, lam=0.5)
    torch.testing.assert_close(advantage, column(*want))
    torch.testing.assert_close(returns, column(*want) + V)


def test_one_episode_that_goes_on():
    # delta = (1 + .5 - .5, 2 + .75 - 1, 3 + 1 - 1.5) = (1, 1.75, 2.5);
    # A_2 = 2.5; A_1 = 1.75 + .25 * 2.5 = 2.375; A_0 = 1 + .25 * 2.375 = 1.59375.
    check(NONE, NONE, (1.59375, 2.375, 2.5))


def test_a_failure_cuts_the_value_and_the_trace():
    # delta_1 = 2 - 1 = 1 without what follows; A_0 = 1 + .25 * 1 = 1.25.
    check(flags(0, 1, 0), NONE, (1.25, 1.0, 2.5))


def test_a_time_out_cuts_the_trace_and_keeps_the_value():
    # The state reached is worth 4: delta_1 = 2 + .5 * 4 - 1 = 3; A_0 = 1 + .25 * 3 = 1.75.
    check(NONE, flags(0, 1, 0), (1.75, 3.0, 2.5), next_value=column(1, 4, 2))


def test_failure_wins_over_time_out():
    check(flags(0, 1, 0), flags(0, 1, 0), (1.25, 1.0, 2.5), next_value=column(1, 4, 2))


def test_lambda_one_gives_discounted_returns():
    _, returns = gae(R, V, NEXT, NONE, NONE, gamma=0.5, lam=1.0)
    # R_0 = 1 + .5 * 2 + .25 * 3 + .125 * V(s_3) = 1 + 1 + .75 + .25.
    torch.testing.assert_close(returns[0, 0].item(), 3.0)


def test_equals_the_sum_of_its_definition():
    g = torch.Generator().manual_seed(0)
    T, N, gamma, lam = 12, 5, 0.9, 0.8
    r, v, nv = (torch.randn(T, N, generator=g, dtype=torch.float64) for _ in range(3))
    term, trunc = (torch.rand(T, N, generator=g) < 0.2 for _ in range(2))
    advantage, _ = gae(r, v, nv, term, trunc, gamma, lam)
    for n in range(N):
        for t in range(T):
            total, weight = 0.0, 1.0
            for k in range(t, T):
                future = 0.0 if term[k, n] else float(nv[k, n])
                total += weight * (float(r[k, n]) + gamma * future - float(v[k, n]))
                if term[k, n] or trunc[k, n]:
                    break
                weight *= gamma * lam
            torch.testing.assert_close(float(advantage[t, n]), total)
