"""A kinematic policy with futures made of cosines: the same conditional variational autoencoder as
`nets.cvae`, with perceptrons where that has recurrent units.

    y(t) = y_0 + tau (1 - exp(-t / tau)) v_0 + r(t) sum_k c_k cos(pi k (t - 1/2) / f),  c = MLP[past; z]

with y_0 and v_0 the past's last frame and its velocity and r(t) = min(t / 10, 1)^2. So a segment goes on
where the past ends and as fast, without frequencies above those that people move with, and all frames of
it are made at once: a step of training costs a tenth of one through 60 recurrent steps.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from poise.nets.cvae import CVAE, Code, CVAEConfig
from poise.nets.mlp import bare_linear, product

_MIN_STD = 1e-3
#: Frames in which a velocity that is left to itself dies down, and in which cosines set in.
_FADE, _RAMP = 4.0, 10.0
#: Between which the logarithm of a code's variance stays.
_LOG_VAR = (-8.0, 2.0)


class CosineCVAE(nn.Module):
    """The encoder and the decoder; see the module's text. What its methods do is as in `CVAE`.

    Args:
        features: numbers in a frame.
        generator: source of the first weights.
    """

    mean: Tensor
    std: Tensor
    seen: Tensor
    told: Tensor
    coming: Tensor
    going: Tensor

    def __init__(self, features: int, config: CVAEConfig, *, generator: torch.Generator):
        super().__init__()
        self.features, self.config = features, config
        c = config
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("std", torch.ones(features))
        # Made from the sizes, so not among the weights.
        t = torch.arange(1, c.future + 1, dtype=torch.float32)
        ramp = (t / _RAMP).clamp_max(1.0).square()[:, None]
        known, made = min(c.past, c.cosines), min(c.future, c.cosines)
        self.register_buffer("seen", cosines(c.past, known), persistent=False)
        self.register_buffer("coming", cosines(c.future, made), persistent=False)
        self.register_buffer("told", ramp * cosines(c.future, made) * c.future**0.5, persistent=False)
        self.register_buffer("going", _FADE * (1 - torch.exp(-t / _FADE)), persistent=False)
        wide = (known + 2) * features
        self.encoder = Residual(wide + made * features, c.hidden, c.blocks, 2 * c.latent, 0.1, generator)
        self.decoder = Residual(wide + c.latent, c.hidden, c.blocks, made * features, 0.1, generator)

    @torch.no_grad()
    def calibrate(self, frames: Tensor) -> None:
        """Takes the scale of every number from frames `(F, D)`."""
        self.mean.copy_(frames.mean(0))
        self.std.copy_(frames.std(0).clamp_min(_MIN_STD))

    def scaled(self, frames: Tensor) -> Tensor:
        """Frames in deviations from the mean."""
        return (frames - self.mean) / self.std

    def _context(self, past: Tensor) -> Tensor:
        """What is seen of a past: its slow part, its last frame, its velocity (in 5 frames' change)."""
        with _exact():
            low = torch.einsum("tk,ntd->nkd", self.seen, past) / self.config.past**0.5
        last = past[:, -1]
        return torch.cat((low.flatten(1), last, 5 * (last - past[:, -2])), -1)

    def encode(self, past: Tensor, future: Tensor) -> Code:
        """What happens after a past `(N, p, D)` in a future `(N, f, D)`, both scaled."""
        with _exact():
            ahead = torch.einsum("tk,ntd->nkd", self.coming, future - past[:, -1:])
            ahead = ahead / self.config.future**0.5
        code = self.encoder(torch.cat((self._context(past), ahead.flatten(1)), -1))
        mean, log_var = code.float().chunk(2, -1)
        return Code(mean, log_var.clamp(*_LOG_VAR))

    def decode(self, past: Tensor, z: Tensor, frames: int | None = None) -> Tensor:
        """The mean future `(N, f, D)` after a past `(N, p, D)`, both scaled, with `z (N, Z)`."""
        f = frames or self.config.future
        parts = self.decoder(torch.cat((self._context(past), z), -1))
        parts = parts.unflatten(-1, (-1, self.features)).float()
        last = past[:, -1]
        going = last[:, None] + self.going[:f, None] * (last - past[:, -2])[:, None]
        with _exact():
            return going + torch.einsum("tk,nkd->ntd", self.told[:f], parts)

    def draw(self, count: int, rng: torch.Generator, temperature: float = 1.0) -> Tensor:
        """z `(count, Z)` of the prior N(0, temperature^2)."""
        return temperature * torch.randn(count, self.config.latent, generator=rng).to(self.mean)

    def continued(self, past: Tensor, z: Tensor) -> Tensor:
        """The same as `decode` in the frames' own units."""
        return self.decode(self.scaled(past), z) * self.std + self.mean


class Residual(nn.Module):
    """A perceptron with layers that add to what came before them: x + W_2 silu(W_1 norm(x))."""

    def __init__(
        self, num_in: int, width: int, blocks: int, num_out: int, last: float, rng: torch.Generator
    ):
        super().__init__()
        self.enter = _layer(num_in, width, 1.0, rng)
        self.norms = nn.ModuleList([nn.LayerNorm(width) for _ in range(blocks)])
        self.up = nn.ModuleList([_layer(width, width, 1.0, rng) for _ in range(blocks)])
        self.down = nn.ModuleList([_layer(width, width, 0.3, rng) for _ in range(blocks)])
        self.leave = _layer(width, num_out, last, rng)

    def forward(self, x: Tensor) -> Tensor:
        """`(N, num_in)` to `(N, num_out)`."""
        x = product(self.enter, x)
        for norm, up, down in zip(self.norms, self.up, self.down, strict=True):
            x = x + product(down, nn.functional.silu(product(up, norm(x))))
        return product(self.leave, x, last=True)


def make_cvae(features: int, config: CVAEConfig, rng: torch.Generator) -> CVAE | CosineCVAE:
    """The network that a configuration names, with first weights from `rng`."""
    kind = CVAE if config.decoder == "recurrent" else CosineCVAE
    return kind(features, config, generator=rng)


def cosines(frames: int, count: int) -> Tensor:
    """The slowest `count` orthonormal cosines of `frames` frames `(frames, count)` (DCT-II)."""
    t, k = torch.arange(frames).double()[:, None], torch.arange(count).double()
    out = torch.cos(math.pi * (t + 0.5) * k / frames) * math.sqrt(2 / frames)
    out[:, 0] /= math.sqrt(2)
    return out.float()


def _exact() -> torch.autocast:
    """Sums of frames stay in float32 where layers are in bfloat16."""
    return torch.autocast("cpu", enabled=False)


def _layer(num_in: int, num_out: int, scale: float, rng: torch.Generator) -> nn.Linear:
    layer = bare_linear(num_in, num_out)
    with torch.no_grad():
        layer.weight.uniform_(-scale * num_in**-0.5, scale * num_in**-0.5, generator=rng)
        layer.bias.zero_()
    return layer
