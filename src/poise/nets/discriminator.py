"""The discriminator of an adversarial motion prior (Peng et al. 2021): is this motion a clip's?"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from poise.nets.mlp import MLP
from poise.nets.norm import RunningNorm


class Discriminator(nn.Module):
    """One logit D per window of W frames with F features: high for clips, low for the character.

    Args:
        frames, features: W and F.
        hidden, activation: of the perceptron over the W F normalised features.
        clip: bound of the normalised features. Their statistics are shared by the frames of a window.
        generator: source of the first weights.
    """

    def __init__(
        self,
        frames: int,
        features: int,
        hidden: Sequence[int] = (256, 128),
        activation: str = "relu",
        clip: float = 5.0,
        *,
        generator: torch.Generator,
    ):
        super().__init__()
        self.frames, self.features = frames, features
        self.norm = RunningNorm(features, clip)
        self.net = MLP(frames * features, hidden, 1, activation, generator=generator)

    def normalise(self, windows: Tensor) -> Tensor:
        """Windows `(N, W F)` or `(N, W, F)`, oldest frame first, as what the network sees `(N, W F)`."""
        return self.norm(windows.reshape(-1, self.frames, self.features)).flatten(1)

    def logit(self, x: Tensor) -> Tensor:
        """D `(N,)` of normalised windows `(N, W F)`."""
        return self.net(x).squeeze(-1)

    def forward(self, windows: Tensor) -> Tensor:
        """D `(N,)` of raw windows `(N, W F)` or `(N, W, F)`."""
        return self.logit(self.normalise(windows))

    def weights(self) -> list[Tensor]:
        """The weight matrices without the biases, the output layer's last."""
        return [p for name, p in self.net.named_parameters() if name.endswith("weight")]


def gradient_penalty(net: Discriminator, x: Tensor) -> tuple[Tensor, Tensor]:
    """mean_n ||dD/dx_n||^2 of normalised windows `x (N, W F)`, a scalar with gradients; and D `(N,)`."""
    x = x.detach().requires_grad_()
    logit = net.logit(x)
    (slope,) = torch.autograd.grad(logit.sum(), x, create_graph=True)
    return slope.square().sum(-1).mean(), logit
