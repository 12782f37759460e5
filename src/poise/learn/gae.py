"""Generalised advantage estimation (Schulman et al. 2016)."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    gamma: float,
    lam: float,
) -> tuple[Tensor, Tensor]:
    """Advantages and lambda-returns, each `(T, N)`.

    Args:
        reward: `(T, N)` r_t.
        value: `(T, N)` V(s_t).
        next_value: `(T, N)` V of the state that the step reached, before any reset.
        terminated: `(T, N)` bool, the state reached is a failure: its value counts as 0.
        truncated: `(T, N)` bool, the episode was cut there: its value is bootstrapped.
        gamma, lam: the discount and the mixing of n-step advantages.
    """
    # delta_t = r_t + gamma V(s_{t+1}) [not terminated] - V(s_t)
    delta = reward + gamma * next_value * ~terminated - value
    # A_t = delta_t + gamma lambda [episode goes on] A_{t+1}
    decay = gamma * lam * (~(terminated | truncated)).to(delta.dtype)
    advantage = torch.empty_like(delta)
    following = torch.zeros_like(delta[0])
    for t in range(len(delta) - 1, -1, -1):
        following = torch.addcmul(delta[t], decay[t], following, out=advantage[t])
    # The return that the critic learns: R_t = A_t + V(s_t)
    return advantage, advantage + value
