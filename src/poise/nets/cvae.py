"""A kinematic policy: what follows a second of motion, as a conditional variational autoencoder.

Residual Force Control, section 5 and appendix C.2: kappa(x_{t:t+f} | x_{t-p:t}, z), with an encoder
q(z | past, future) that training alone needs. Both are GRUs. Frames are rows of numbers here; what they
mean, and that they know no place, is `synth.place_free`'s business.

    h_p = GRU(past),  (mu, log s^2) = MLP[h_p; GRU(future)],  y_k = y_{k-1} + MLP(GRU([h_p; z; y_{k-1}]))

A frame is the one before it plus what is said of it, so that a segment begins where the past ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.nets.mlp import MLP, bare_linear
from poise.settings import validate

_MIN_STD = 1e-3


@dataclass(frozen=True)
class CVAEConfig:
    """Sizes; widths of the layers stand in a picture that the paper's text does not give, and are ours.

    Attributes:
        past, future: p and f, frames that are seen and made.
        latent: size of z.
        hidden: width of the recurrent units.
        layers: widths of the layers between them and what they say.
        decoder: "recurrent", the paper's, or "cosine", see `nets.cosine_cvae`, for which `hidden`
            counts as well, but not `layers`.
        cosines: of "cosine", how many a past and a future are made of. 24 of 60 frames at 30 Hz go up
            to 6 Hz.
        blocks: of "cosine", pairs of layers.
    """

    past: int = 30
    future: int = 60
    latent: int = 128
    hidden: int = 256
    layers: tuple[int, ...] = (256,)
    decoder: Literal["recurrent", "cosine"] = "recurrent"
    cosines: int = 24
    blocks: int = 2

    def __post_init__(self) -> None:
        validate(self)
        sizes = (self.past, self.future, self.latent, self.hidden, self.cosines, self.blocks)
        if min(*sizes, *self.layers) < 1 or self.past < 2:
            raise PoiseError("every size must be at least 1, and the past 2 frames", "CVAEConfig")


class Code(NamedTuple):
    """The encoder's Gaussian: `mean (N, Z)` and `log_var (N, Z)`."""

    mean: Tensor
    log_var: Tensor

    def draw(self, rng: torch.Generator) -> Tensor:
        """A sample `(N, Z)`, through which gradients flow."""
        noise = torch.randn(self.mean.shape, generator=rng).to(self.mean)
        return self.mean + (0.5 * self.log_var).exp() * noise

    def divergence(self) -> Tensor:
        """KL(q || N(0, I)) `(N)`, nats."""
        return 0.5 * (self.mean.square() + self.log_var.exp() - 1 - self.log_var).sum(-1)


class CVAE(nn.Module):
    """The encoder and the decoder; see the module's text.

    Args:
        features: numbers in a frame.
        generator: source of the first weights.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, features: int, config: CVAEConfig | None = None, *, generator: torch.Generator):
        super().__init__()
        self.features, self.config = features, config or CVAEConfig()
        c = self.config
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("std", torch.ones(features))
        self.seen = _gru(features, c.hidden, generator)
        self.coming = _gru(features, c.hidden, generator)
        self.posterior = MLP(2 * c.hidden, c.layers, 2 * c.latent, "relu", 0.1, generator=generator)
        self.begin = MLP(c.hidden + c.latent, c.layers, c.hidden, "relu", generator=generator)
        self.cell = Cell(c.hidden + c.latent, features, c.hidden, generator)
        self.said = MLP(c.hidden, c.layers, features, "relu", 0.1, generator=generator)

    @torch.no_grad()
    def calibrate(self, frames: Tensor) -> None:
        """Takes the scale of every number from frames `(F, D)`."""
        self.mean.copy_(frames.mean(0))
        self.std.copy_(frames.std(0).clamp_min(_MIN_STD))

    def scaled(self, frames: Tensor) -> Tensor:
        """Frames in deviations from the mean."""
        return (frames - self.mean) / self.std

    def encode(self, past: Tensor, future: Tensor) -> Code:
        """What happens after a past `(N, p, D)` in a future `(N, f, D)`, both scaled."""
        a, b = self.seen(past)[1][0], self.coming(future)[1][0]
        return Code(*self.posterior(torch.cat((a, b), -1)).chunk(2, -1))

    def decode(self, past: Tensor, z: Tensor, frames: int | None = None) -> Tensor:
        """The mean future `(N, f, D)` after a past `(N, p, D)`, both scaled, with `z (N, Z)`."""
        h = self.seen(past)[1][0]
        context = torch.cat((h, z), -1)
        memory, y, out = self.begin(context), past[:, -1], list[Tensor]()
        steady = self.cell.steady(context)
        for _ in range(frames or self.config.future):
            memory = self.cell(steady, y, memory)
            y = y + self.said(memory)
            out.append(y)
        return torch.stack(out, 1)

    def draw(self, count: int, rng: torch.Generator, temperature: float = 1.0) -> Tensor:
        """z `(count, Z)` of the prior N(0, temperature^2)."""
        return temperature * torch.randn(count, self.config.latent, generator=rng).to(self.mean)

    def continued(self, past: Tensor, z: Tensor) -> Tensor:
        """The same as `decode` in the frames' own units."""
        return self.decode(self.scaled(past), z) * self.std + self.mean


class Cell(nn.Module):
    """A gated recurrent unit (Cho et al. 2014) with a part of its input that stays the same.

        r, u = sigma(a_r + b_r), sigma(a_u + b_u),  n = tanh(a_n + r b_n),  h' = (1 - u) n + u h

    with a = W [context; y] + c and b = V h + d. What the context adds is worked out once.
    """

    def __init__(self, context: int, features: int, hidden: int, generator: torch.Generator):
        super().__init__()
        self.of_context = bare_linear(context, 3 * hidden)
        self.of_input = bare_linear(features, 3 * hidden, bias=False)
        self.of_memory = bare_linear(hidden, 3 * hidden)
        _fill(self, hidden, generator)

    def steady(self, context: Tensor) -> Tensor:
        """What a context `(N, C)` adds to every step, `(N, 3 h)`."""
        return self.of_context(context)

    def forward(self, steady: Tensor, y: Tensor, memory: Tensor) -> Tensor:
        """The memory `(N, h)` after an input `y (N, D)`."""
        a_r, a_u, a_n = (steady + self.of_input(y)).chunk(3, -1)
        b_r, b_u, b_n = self.of_memory(memory).chunk(3, -1)
        update = torch.sigmoid(a_u + b_u)
        new = torch.tanh(a_n + torch.sigmoid(a_r + b_r) * b_n)
        return torch.lerp(new, memory, update)


def _gru(features: int, hidden: int, generator: torch.Generator) -> nn.GRU:
    # Nothing is drawn from the global generator.
    with torch.random.fork_rng(devices=[]):
        module = nn.GRU(features, hidden, batch_first=True)
    _fill(module, hidden, generator)
    return module


def _fill(module: nn.Module, hidden: int, generator: torch.Generator) -> None:
    """The usual first weights of recurrent units, U(-1 / sqrt(h), 1 / sqrt(h))."""
    with torch.no_grad():
        for p in module.parameters():
            p.uniform_(-(hidden**-0.5), hidden**-0.5, generator=generator)
