"""What PPO learns from a rollout: advantages, the loss it descends, and how good its critic is."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from poise.learn.config import PPOConfig
from poise.learn.parallel import Comm, moments
from poise.nets import gaussian_entropy, gaussian_kl, gaussian_log_prob


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
    """Advantages and lambda-returns, each `(T, N)` (Schulman et al. 2016).

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


class Drawn(NamedTuple):
    """What the old policy drew.

    Attributes:
        action: `(B, D)`.
        log_prob: `(B,)`, log-probability of the action.
        mean: `(B, D)`.
        log_std: log sigma, `(D,)` where it is the same for all samples or `(B, D)`.
    """

    action: Tensor
    log_prob: Tensor
    mean: Tensor
    log_std: Tensor

    def take(self, index: Tensor) -> Drawn:
        """Some of the samples."""
        action, log_prob, mean = (x.index_select(0, index) for x in self[:3])
        own = self.log_std.dim() > 1
        return Drawn(
            action, log_prob, mean, self.log_std.index_select(0, index) if own else self.log_std
        )


def clipped_surrogate(log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """The policy loss: -mean min(r A, clip(r, 1 - e, 1 + e) A) with r = pi / pi_old; a scalar."""
    ratio = (log_prob - old_log_prob).exp()
    clipped = ratio.clamp(1 - clip, 1 + clip)
    return -torch.minimum(ratio * advantage, clipped * advantage).mean()


def policy_loss(
    config: PPOConfig, mean: Tensor, log_std: Tensor, advantage: Tensor, old: Drawn
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The loss to descend, and for the log: itself, the KL and the share of clipped ratios.

    `mean (B, D)` and `log_std`, `(D,)` or `(B, D)`, are the present policy's.
    """
    log_prob = gaussian_log_prob(old.action, mean, log_std)
    loss = clipped_surrogate(log_prob, old.log_prob, advantage, config.clip)
    if config.entropy_weight:
        loss = loss - config.entropy_weight * gaussian_entropy(log_std).mean()
    if config.bound_weight:
        excess = (mean.abs() - config.bound_limit).relu()
        loss = loss + config.bound_weight * excess.square().sum(-1).mean()
    with torch.no_grad():
        kl = gaussian_kl(old.mean, old.log_std, mean, log_std).mean()
        # |r - 1| > e
        clipped = ((log_prob - old.log_prob).expm1().abs() > config.clip).float().mean()
    return loss, loss.detach(), kl, clipped


def explained_variance(comm: Comm, returns: Tensor, value: Tensor) -> float:
    """1 - Var(R - V) / Var(R) over all processes."""
    spread = float(moments(comm, returns)[1])
    return 1 - (float(moments(comm, returns - value)[1]) / spread) ** 2 if spread > 0 else 0.0
