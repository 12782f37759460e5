"""Diagonal Gaussians, written out by hand so that one minibatch costs few small operations."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.nets.mlp import MLP
from poise.nets.progressive import ProgressiveNet

#: What may give the mean of a policy.
MeanNet = MLP | ProgressiveNet


def gaussian_log_prob(x: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log density of `x (..., A)` under N(mean, diag(exp(log_std))^2), summed over A: `(...)`.

    log p = -1/2 sum_i ((x_i - mu_i) / sigma_i)^2 - sum_i log sigma_i - A/2 log 2 pi

    `log_std` is one number, `(A,)` for all rows, or `(..., A)`.
    """
    z = (x - mean) * (-log_std).exp()
    # One deviation for all rows is summed once.
    logs = log_std.sum(-1) if log_std.dim() > 1 else log_std.expand(x.shape[-1]).sum()
    constant = logs + 0.5 * x.shape[-1] * math.log(2 * math.pi)
    return -0.5 * (z * z).sum(-1) - constant


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """Entropy in nats, summed over the actions, `(...)` of `log_std (..., A)`:
    sum_i (log sigma_i + 1/2 log(2 pi e))."""
    return (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum(-1)


def gaussian_kl(mean_p: Tensor, log_std_p: Tensor, mean_q: Tensor, log_std_q: Tensor) -> Tensor:
    """KL(p || q) of diagonal Gaussians in nats, summed over the last dimension: `(...)`.

    KL = sum_i [ log(sigma_q / sigma_p) + (sigma_p^2 + (mu_p - mu_q)^2) / (2 sigma_q^2) - 1/2 ]
    """
    square = (2 * log_std_p).exp() + (mean_p - mean_q) ** 2
    return (log_std_q - log_std_p + 0.5 * square * (-2 * log_std_q).exp() - 0.5).sum(-1)


class GaussianPolicy(nn.Module):
    """A policy pi(a | s) = N(mean(s), diag(sigma)^2) with a sigma that does not depend on s.

    PPO asks of a policy `context`, `distribution` and `drive`. Another kind (`nets.Composer`) may draw
    something else than the action, of a sigma that depends on s.

    Args:
        mean: the network of the mean; its output layer should start small (`last_scale=0.1`).
        std: sigma, one number or one per action.
        learn_std: whether log sigma is a parameter to learn or a constant.
    """

    def __init__(self, mean: MeanNet, std: float | Sequence[float], learn_std: bool = False):
        super().__init__()
        stds = torch.as_tensor(std, dtype=torch.float64).reshape(-1)
        if len(stds) not in (1, mean.num_out) or not bool((stds > 0).all()):
            raise PoiseError(
                f"the action noise must be one positive number or one for each of the {mean.num_out} "
                f"actions, got {std}"
            )
        self.mean = mean
        log_std = stds.expand(mean.num_out).log().float().clone()
        self.log_std = nn.Parameter(log_std, requires_grad=learn_std)

    @property
    def num_obs(self) -> int:
        """O, the width of an observation."""
        return self.mean.num_in

    @property
    def num_drawn(self) -> int:
        """D, the width of what is drawn and learned."""
        return self.mean.num_out

    @property
    def num_actions(self) -> int:
        """A, the width of an action."""
        return self.num_drawn

    @property
    def action_log_std(self) -> Tensor:
        """log sigma `(A,)` of the actions, as a scale for errors; the same in all states."""
        return self.log_std

    def context(self, obs: Tensor) -> Tensor | None:
        """What parts that do not learn say of normalised `obs (N, O)`: `(N, C)`, or None if nothing.

        It is computed once where `distribution` is asked for again and again.
        """
        return None

    def distribution(self, obs: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean `(N, D)` and log sigma, `(D,)` or `(N, D)`, of what is drawn, with gradients.

        Normalised `obs (N, O)` in bfloat16 are multiplied in bfloat16, see `MLP`.
        """
        return self.mean.forward(obs), self.log_std

    def drive(self, drawn: Tensor, context: Tensor | None = None) -> Tensor:
        """The action `(N, A)` that something drawn `(N, D)` stands for."""
        return drawn

    def forward(self, obs: Tensor) -> Tensor:
        """The mean `(..., D)` for normalised observations `(..., O)`."""
        return self.distribution(obs)[0]

    def act(self, obs: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """A drawn action `(..., A)`, or the mean action without a generator."""
        context = self.context(obs)
        drawn, log_std = self.distribution(obs, context)
        if generator is not None:
            noise = torch.randn(drawn.shape, generator=generator, device=drawn.device, dtype=drawn.dtype)
            drawn = drawn + noise * log_std.exp()
        return self.drive(drawn, context)
