"""Networks that say the next frame from all before it: baselines of a kinematic policy.

- ERD (Fragkiadaki et al. 2015, Sec. 3): encoder, two recurrent layers, decoder; inputs with noise.
- acLSTM (Zhou et al. 2018, Sec. 3): three recurrent layers that see their own output now and then.
- What Residual Force Control compares with as EgoPose: no kinematic policy, the next frame from the
  past; here one recurrent layer.

All predict how a frame changes, in deviations, so that a fresh network stands nearly still.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.learn.cvae import PackedFrames
from poise.settings import validate
from poise.synthesis.generator import coordinates, past_features

#: Least deviation of a number.
_MIN_STD = 1e-2
#: Norm to which gradients are scaled down.
_GRAD_NORM = 1.0
#: What changes in a frame is about so many deviations.
_CHANGE = 0.1


@dataclass(frozen=True)
class NextFrameConfig:
    """Sizes, and what the inputs are in training.

    Attributes:
        past: frames that are seen before the first one is made. future: frames that are made at once.
        encoder, decoder: widths of their layers.
        hidden, layers: of the recurrent part, an LSTM.
        noise: deviation of what is added to inputs, in deviations.
        truth, own: frames that are seen as they are, then so many of its own, again and again; own=0
            sees no frame of its own.
    """

    past: int = 30
    future: int = 60
    encoder: tuple[int, ...] = ()
    decoder: tuple[int, ...] = ()
    hidden: int = 512
    layers: int = 1
    noise: float = 0.0
    truth: int = 1
    own: int = 0

    def __post_init__(self) -> None:
        validate(self)
        if min(self.past, self.future, self.hidden, self.layers, self.truth) < 1 or self.own < 0:
            raise PoiseError(
                "past, future, hidden, layers and truth must be at least 1, and own at least 0",
                "NextFrameConfig",
                code="out-of-range",
            )

    @classmethod
    def erd(cls) -> NextFrameConfig:
        """Encoder and decoder of two layers, two recurrent ones, noise."""
        return cls(encoder=(500, 500), decoder=(500, 100), hidden=512, layers=2, noise=0.05)

    @classmethod
    def aclstm(cls) -> NextFrameConfig:
        """Three recurrent layers; five frames of the truth, five of its own."""
        return cls(hidden=512, layers=3, truth=5, own=5)

    @classmethod
    def egopose(cls) -> NextFrameConfig:
        """The next frame from the past."""
        return cls(hidden=512, decoder=(300,))


class NextFrame(nn.Module):
    """The next frame `(N, D)` from all before it.

    Args:
        features: D, numbers of a frame.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, features: int, config: NextFrameConfig, generator: torch.Generator):
        super().__init__()
        self.features, self.config, c = features, config, config
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("std", torch.ones(features))
        self.encoder = _layers((features, *c.encoder), True)
        wide = c.encoder[-1] if c.encoder else features
        self.recurrent = nn.LSTM(wide, c.hidden, c.layers, batch_first=True)
        self.decoder = _layers((c.hidden, *c.decoder, features), False)
        with torch.no_grad():
            for weight in self.parameters():
                size = weight.shape[-1] ** -0.5 if weight.ndim > 1 else 0.0
                weight.uniform_(-size, size, generator=generator)

    @torch.no_grad()
    def calibrate(self, frames: Tensor) -> None:
        """Takes the scale of every number from frames `(F, D)`."""
        self.mean.copy_(frames.mean(0))
        self.std.copy_(frames.std(0).clamp_min(_MIN_STD))

    def scaled(self, frames: Tensor) -> Tensor:
        """Frames in deviations from the mean."""
        return (frames - self.mean) / self.std

    def after(
        self, frames: Tensor, state: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """What follows each of scaled `frames (N, T, D)`, and the state to go on with."""
        out, last = self.recurrent(self.encoder(frames), state)
        return frames + _CHANGE * self.decoder(out), last

    def trained(self, frames: Tensor, rng: torch.Generator) -> Tensor:
        """What follows each of scaled `frames (N, T, D)`, seen as in training `(N, T, D)`."""
        c, length = self.config, frames.shape[1]
        if c.noise:
            frames = frames + c.noise * torch.randn(frames.shape, generator=rng)
        if not c.own:
            return self.after(frames)[0]
        made, state = list[Tensor](), None
        for first in range(0, length, c.truth + c.own):
            some, state = self.after(frames[:, first : first + c.truth], state)
            made.append(some)
            for _ in range(min(c.own, length - first - c.truth)):
                some, state = self.after(made[-1][:, -1:], state)
                made.append(some)
        return torch.cat(made, 1)

    def continued(self, past: Tensor, noise: Tensor | None = None) -> Tensor:
        """Frames `(N, f, D)` that follow `past (N, p, D)`, both in their own units.

        noise: `(N, 1, D)` in deviations, added to the past.
        """
        x = self.scaled(past)
        x = x if noise is None else x + noise
        some, state = self.after(x)
        made = [some[:, -1:]]
        for _ in range(self.config.future - 1):
            some, state = self.after(made[-1], state)
            made.append(some)
        return torch.cat(made, 1) * self.std + self.mean


def _layers(sizes: tuple[int, ...], bent: bool) -> nn.Sequential:
    """Linear layers with ReLU between them, and after the last one where `bent`."""
    out = list[nn.Module]()
    for k, (a, b) in enumerate(itertools.pairwise(sizes)):
        out.append(nn.utils.skip_init(nn.Linear, a, b))
        if bent or k < len(sizes) - 2:
            out.append(nn.ReLU())
    return nn.Sequential(*out)


class NextFrameObjective:
    """Loss and update; see `learn.inbetween_model.InbetweenTrainer`.

    Args:
        batch: windows in a step. lr: Adam's step size.
    """

    def __init__(self, net: NextFrame, batch: int = 64, lr: float = 1e-3):
        self.net, self.batch = net, batch
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "net": torch.optim.Adam(net.parameters(), lr=lr)
        }

    def modules(self) -> Mapping[str, torch.nn.Module]:
        """What is trained, by name."""
        return {"net": self.net}

    def step(self, sampler: PackedFrames, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        """One update; the loss."""
        window = self.net.config.past + self.net.config.future
        x = self.net.scaled(sampler.draw(self.batch, window, generator))
        made = self.net.trained(x[:, :-1], generator)
        loss = (made - x[:, 1:]).square().mean()
        optimizer = self.optimizers["net"]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), _GRAD_NORM)
        optimizer.step()
        return {"loss": loss.detach()}


class NextFrames:
    """Makes the next segment of motion frame by frame (`env.generator_goal.MotionGenerator`).

    Args:
        net: the trained network.
        seeds: `(S, p, 7 + n)` pasts from which motions begin.
        fps: frames a second.
        bounds: `(2, n)` rad, least and most of each hinge; None leaves angles as they are made.
    """

    def __init__(self, net: NextFrame, seeds: Tensor, fps: float, bounds: Tensor | None = None):
        if seeds.ndim != 3 or seeds.shape[1] != net.config.past or not len(seeds):
            raise PoiseError(
                f"seeds must be pasts of {net.config.past} frames, got {tuple(seeds.shape)}",
                "NextFrames",
                code="wrong-shape",
            )
        self.net, self.seeds, self.fps, self.bounds = net.eval(), seeds.double(), fps, bounds
        self.past, self.future = net.config.past, net.config.future

    def begin(self, count: int, rng: torch.Generator) -> Tensor:
        """`(count, past, 7 + n)` of the seeds, drawn evenly, set to the origin."""
        frames = self.seeds[torch.randint(len(self.seeds), (count,), generator=rng)].clone()
        frames[..., :2] -= frames[:, -1:, :2].clone()
        return frames

    def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        """`(n, future, 7 + n)` after `past (n, past, 7 + n)`."""
        return self.propose(past, rng, 1)[:, 0]

    @torch.no_grad()
    def propose(self, past: Tensor, rng: torch.Generator, count: int) -> Tensor:
        """`(n, count, future, 7 + n)`: futures differ by the noise that training had; without any they
        are the same."""
        frames = past_features(past.double(), self.fps).float().repeat_interleave(count, 0)
        noise = self.net.config.noise * torch.randn(len(frames), 1, frames.shape[-1], generator=rng)
        made = self.net.continued(frames, noise if self.net.config.noise else None).double()
        out = coordinates(made, past[:, -1].double().repeat_interleave(count, 0), self.fps)
        if self.bounds is not None:
            out[..., 7:] = out[..., 7:].clamp(*self.bounds)
        return out.unflatten(0, (len(past), count))

    def rows(self) -> Mapping[str, Tensor]:
        """It remembers nothing but the past that it is given."""
        return {}
