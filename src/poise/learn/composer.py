"""The multiplicative composer: one policy out of frozen primitives (MCP, Peng et al. 2019; PHC, 3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from poise.errors import PoiseError
from poise.learn.networks import MLP, GaussianPolicy, ProgressiveNet

Combine = Literal["product", "means"]
Weights = Literal["softmax", "softplus", "relu", "silu"]
# So that some primitive always acts: a product in which all weights are 0 has no mean.
_LEAST_WEIGHT = 1e-4

_WEIGHTS: dict[str, Callable[[Tensor], Tensor]] = {
    "softmax": lambda x: x.softmax(-1),
    "softplus": functional.softplus,
    "relu": functional.relu,
    "silu": functional.silu,
}


def product_of_gaussians(weight: Tensor, mean: Tensor, log_std: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and log sigma `(..., A)` of the normalised product of N(mu_k, sigma_k^2)^(w_k).

    PHC Eqs. 5 and 6, per action j, with sigma^2 where the paper, as MCP before it, writes the variance
    as sigma (the exponent of a Gaussian multiplies its precision 1 / sigma^2):

        mu = sum_k(w_k mu_k / sigma_k^2) / sum_k(w_k / sigma_k^2),   sigma^2 = 1 / sum_k(w_k / sigma_k^2)

    Args:
        weight: `(..., K)`, at least 0 and not all 0.
        mean: `(..., K, A)`.
        log_std: `(K, A)`.
    """
    precision = weight.unsqueeze(-1) * (-2 * log_std).exp()
    total = precision.sum(-2)
    return (precision * mean).sum(-2) / total, -0.5 * total.log()


class Composer(GaussianPolicy):
    """Chooses from state to state how much each of K primitives acts.

    combine "product" (PHC's paper): PPO draws actions from the `product_of_gaussians`, with a sigma
    that follows from the weights. "means" (PHC's code): PPO draws the K weights, with noise of their
    own, and the action is sum_k(w_k mu_k).

    Args:
        primitives: the columns; they are frozen unless `joint`.
        log_std: `(K, A)` log sigma of the primitives; with "means" they do not matter.
        hidden, activation: of the network that scores the primitives, which sees what they see.
        combine: see above.
        weights: what makes weights of scores: softmax, softplus, relu, or silu as in PHC's code, which
            has no softmax. At first all are 1/K.
        std: with "means", sigma of the noise on the weights.
        learn_std: with "means", whether it is learned.
        joint: whether the primitives learn with the composer (MCP without progressive training); only
            as a product.
        generator: source of the first weights.
    """

    def __init__(
        self,
        primitives: ProgressiveNet,
        log_std: Tensor,
        hidden: Sequence[int] = (256, 128),
        activation: str = "relu",
        combine: Combine = "product",
        weights: Weights = "softmax",
        std: float = 0.1,
        learn_std: bool = False,
        joint: bool = False,
        *,
        generator: torch.Generator,
    ):
        count = len(primitives)
        if combine not in ("product", "means"):
            raise PoiseError(
                f"primitives cannot be combined by '{combine}'",
                hint="Use product or means",
                code="unknown-choice",
            )
        if weights not in _WEIGHTS or (combine == "product" and weights == "silu"):
            names = ", ".join(k for k in _WEIGHTS if combine == "means" or k != "silu")
            hint = f"Use one of {names}"
            raise PoiseError(
                f"the weights of a {combine} cannot be made by '{weights}'",
                hint=hint,
                code="unknown-choice",
            )
        if joint and combine == "means":
            raise PoiseError(
                "primitives cannot learn while their means are only weighed",
                hint="Combine them as a product, from which actions are drawn",
                code="settings-conflict",
            )
        if log_std.shape != (count, primitives.num_out):
            want = (count, primitives.num_out)
            raise PoiseError(
                f"log_std must have the shape {want}, got {tuple(log_std.shape)}", code="wrong-shape"
            )
        scores = MLP(primitives.num_in, hidden, count, activation, last_scale=0.1, generator=generator)
        super().__init__(scores, std, learn_std)
        self.primitives, self.combine, self.weights, self.joint = primitives, combine, weights, joint
        self.primitives.requires_grad_(joint)
        self.primitives.log_std.copy_(log_std)
        if combine == "product":
            self.log_std = nn.Parameter(log_std.clone(), requires_grad=False)
        with torch.no_grad():
            self.mean.last.bias.fill_(_even_score(weights, count))
        self.to(primitives.column(0).last.weight.device)

    @property
    def num_drawn(self) -> int:
        """D: the actions, or the weights with "means"."""
        return self.num_actions if self.combine == "product" else len(self.primitives)

    @property
    def num_actions(self) -> int:
        """A, the width of an action."""
        return self.primitives.num_out

    @property
    def action_log_std(self) -> Tensor:
        """log sigma `(A,)` of the primitives' actions, in the mean."""
        return self.primitives.log_std.mean(0)

    def weight(self, obs: Tensor) -> Tensor:
        """The mean weights `(N, K)` of the primitives for normalised observations `(N, O)`."""
        weight = _WEIGHTS[self.weights](self._scores(obs))
        # A softmax always leaves some; the others may leave nothing.
        plain = self.combine == "means" or self.weights == "softmax"
        return weight if plain else weight + _LEAST_WEIGHT

    def context(self, obs: Tensor) -> Tensor | None:
        """The frozen primitives' means `(N, K A)`; None where they learn too."""
        if self.joint:
            return None
        with torch.no_grad():
            return self.primitives.all(obs).flatten(-2)

    def distribution(self, obs: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean and log sigma of the actions, `(N, A)` each, or of the weights, `(N, K)` and `(K,)`."""
        weight = self.weight(obs)
        if self.combine == "means":
            return weight, self.log_std
        if context is None:
            context = self._means(obs)
        means = context.unflatten(-1, (len(self.primitives), -1))
        return product_of_gaussians(weight, means, self.log_std)

    def drive(self, drawn: Tensor, context: Tensor | None = None) -> Tensor:
        """The action `(N, A)`; weights `(N, K)` need the `context` of the observation."""
        if self.combine == "product":
            return drawn
        assert context is not None, "weights become an action through the primitives' means"
        means = context.unflatten(-1, (len(self.primitives), -1))
        # a = sum_k w_k mu_k
        return (drawn.unsqueeze(-1) * means).sum(-2)

    def _means(self, obs: Tensor) -> Tensor:
        """All primitives' means `(N, K A)`, with gradients where they learn."""
        with torch.set_grad_enabled(self.joint and torch.is_grad_enabled()):
            return self.primitives.all(obs).flatten(-2)

    def _scores(self, obs: Tensor) -> Tensor:
        # The base class multiplies as the observations' type says.
        return super().distribution(obs)[0]


def _even_score(weights: Weights, count: int) -> float:
    """The score from which every one of `count` primitives gets the weight 1 / count."""
    share = 1 / count
    if weights == "softmax":
        return 0.0
    if weights == "softplus":
        return math.log(math.expm1(share))
    score = share
    for _ in range(50 if weights == "silu" else 0):
        # silu(x) = x / (1 + e^-x) = share, solved by iteration.
        score = share * (1 + math.exp(-score))
    return score
