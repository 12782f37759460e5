"""A kinematic policy as a conditional variational autoencoder, and how it is learned (RFC, Eq. 6)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import torch
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.learn.adam import Adam, Optimizer
from poise.learn.networks import MLP, bare_linear, bfloat16_is_fast, product
from poise.settings import Checked, Count, Positive, Range

_MIN_STD = 1e-3


@dataclass(frozen=True)
class CVAEConfig(Checked):
    """Sizes; widths of the layers stand in a picture that the paper's text does not give, and are ours.

    Attributes:
        past, future: p and f, frames that are seen and made.
        latent: size of z.
        hidden: width of the recurrent units.
        layers: widths of the layers between them and what they say.
        decoder: "recurrent", the paper's (`CVAE`), or "cosine" (`CosineCVAE`), for which `hidden` counts
            as well, but not `layers`.
        cosines: of "cosine", how many a past and a future are made of. 24 of 60 frames at 30 Hz go up
            to 6 Hz.
        blocks: of "cosine", pairs of layers.
    """

    past: Annotated[int, Range(2, unit="frames")] = 30
    future: Count = 60
    latent: Count = 128
    hidden: Count = 256
    layers: Annotated[tuple[int, ...], Range(1)] = (256,)
    decoder: Literal["recurrent", "cosine"] = "recurrent"
    cosines: Count = 24
    blocks: Count = 2


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
    """The encoder and the decoder of Residual Force Control (section 5 and appendix C.2), two GRUs.

    The decoder is kappa(x_{t:t+f} | x_{t-p:t}, z). Training alone needs the encoder q(z | past, future):

        h_p = GRU(past),  (mu, log s^2) = MLP[h_p; GRU(future)],
        y_k = y_{k-1} + MLP(GRU([h_p; z; y_{k-1}]))

    A frame is a row of numbers that know no place, see `synthesis.generator.features_of`. Each frame is
    the one before it plus what the decoder says, so that a segment begins where the past ends.

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


_LEAST_COSINE_STD = 1e-3
#: Frames in which a velocity that is left to itself dies down, and in which cosines set in.
_FADE, _RAMP = 4.0, 10.0
#: Between which the logarithm of a code's variance stays.
_LOG_VAR = (-8.0, 2.0)


class CosineCVAE(nn.Module):
    """The encoder and the decoder as perceptrons, for futures made of cosines; its methods do what those
    of `CVAE` do.

        y(t) = y_0 + tau (1 - exp(-t / tau)) v_0 + r(t) sum_k c_k cos(pi k (t - 1/2) / f),
        c = MLP[past; z]

    y_0 and v_0 are the past's last frame and its velocity, and r(t) = min(t / 10, 1)^2. So a segment
    goes on where the past ends and as fast, it has no frequencies above those that people move with, and
    all its frames are made at once.

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
        self.encoder = ResidualLayer(
            wide + made * features, c.hidden, c.blocks, 2 * c.latent, 0.1, generator
        )
        self.decoder = ResidualLayer(
            wide + c.latent, c.hidden, c.blocks, made * features, 0.1, generator
        )

    @torch.no_grad()
    def calibrate(self, frames: Tensor) -> None:
        """Takes the scale of every number from frames `(F, D)`."""
        self.mean.copy_(frames.mean(0))
        self.std.copy_(frames.std(0).clamp_min(_LEAST_COSINE_STD))

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


class ResidualLayer(nn.Module):
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


#: Deviations beyond which numbers of its own past are no motion.
FAR = 8.0


@dataclass(frozen=True)
class CVAETraining(Checked):
    """How it is trained; `paper` has the values that the paper states.

    Attributes:
        batch: windows in a step.
        lr: Adam's step size, constant over `held` of the steps, then falling along a line to 0.
        held: see `lr`.
        beta: variance of the decoder.
        tolerance: nats below which the code's KL costs nothing.
        smooth: weight of the squares of the frames' differences, which the paper does not have: without
            them frames of short trainings tremble.
        own_past: share of batches in which further segments follow what was made of the first.
        segments: the most of them; the paper's n is 5.
        shorter: windows of clips that end before the last of the segments are drawn, too, and have
            fewer; in half of the batches the next segment follows the first half of one. Without it
            short clips are in batches of one segment alone.
        noise: deviation of what is added to pasts, the same to all frames of one, in deviations.
        mix: the most of another window in a past, as a share; in half of the pasts.
        settle: frames in which what is off dies down by e, s above.
        grad_norm: gradients are scaled down to it.
        products: how matrices are multiplied; weights and losses are float32 in any case.
    """

    batch: Count = 128
    lr: Positive = 5e-4
    held: float = 0.5
    beta: Positive = 10.0
    tolerance: float = 20.0
    smooth: float = 10.0
    own_past: float = 0.7
    segments: Count = 3
    shorter: bool = False
    noise: float = 0.05
    mix: float = 0.4
    settle: Positive = 5.0
    grad_norm: Annotated[float, Range(0, above=True, infinite=True)] = 1.0
    products: Literal["auto", "float32", "bfloat16"] = "auto"

    @classmethod
    def paper(cls) -> CVAETraining:
        """200 epochs at a constant step size and 800 in which it falls; minibatches of 256. An epoch's
        batch is 10,000 windows, so that the whole is 40,000 steps."""
        return cls(batch=256, lr=1e-3, held=0.2, tolerance=10.0, smooth=0.0, own_past=0.0,
                   segments=1, noise=0.0, mix=0.0, grad_norm=1e9, products="float32")  # fmt: skip


class PackedFrames:
    """Windows of packed frames.

    Args:
        frames: `(F, D)` of all clips, one after another.
        first: `(C + 1)` rows where clips begin.
        weights: `(C,)` how often windows of each clip are drawn, for each window; by default all are
            drawn evenly.

    Attributes:
        clip: `(F,)` the clip of each frame.
        room: `(F,)` frames of the clip from each one on.
    """

    def __init__(self, frames: Tensor, first: Tensor, weights: Tensor | None = None):
        self.frames, self.first, self.weights = frames, first, weights
        sizes = first[1:] - first[:-1]
        self.clip = torch.repeat_interleave(torch.arange(len(sizes)), sizes)
        self.room = first[1:][self.clip] - torch.arange(len(frames))

    def count(self, window: int) -> int:
        """How many different windows of `window` frames there are."""
        return int((self.room >= window).sum())

    def draw(self, count: int, window: int, generator: torch.Generator) -> Tensor:
        """`(count, window, D)`.

        Raises:
            PoiseError: no clip is long enough.
        """
        return self.taken(self.starts(count, window, generator), window)

    def starts(self, count: int, window: int, generator: torch.Generator) -> Tensor:
        """`(count,)` rows from which `window` frames of a clip follow; errors as those of `draw`."""
        usable = (self.room >= window).nonzero()[:, 0]
        if not len(usable):
            raise PoiseError(
                f"no clip has {window} frames in a row",
                hint="Give longer clips, or see fewer frames",
                code="clip-too-short",
            )
        if self.weights is None:
            return usable[torch.randint(len(usable), (count,), generator=generator)]
        share = self.weights[self.clip[usable]].double().cumsum(0)
        drawn = torch.rand(count, generator=generator, dtype=torch.double) * share[-1]
        return usable[torch.searchsorted(share, drawn, right=True).clamp_max(len(usable) - 1)]

    def taken(self, starts: Tensor, window: int) -> Tensor:
        """`(N, window, D)` from rows `(N,)` on; where a clip ends before, its last frame stays."""
        ends = starts + self.room[starts] - 1
        return self.frames[torch.minimum(starts[:, None] + torch.arange(window), ends[:, None])]


class CVAEObjective:
    """Loss and update of a kinematic policy; see `learn.inbetween_model.InbetweenTrainer`.

    The loss is the evidence lower bound of Residual Force Control's Eq. 6,

        L = |x - x~|^2 / (2 beta) + max(KL(q(z | x) || N(0, I)), tolerance),

    with squares of numbers in deviations, summed over a future. After the first segment a policy sees
    its own past (Algorithm 1, line 11), so the policy learns from that, too: in a share of the batches
    further segments follow those that the policy made. A past that is partly of another window teaches
    the way back to motion that there is.

    Args:
        steps: of the whole training.
        weights: `(D)` of the squares of a frame's numbers; by default all count the same.
    """

    def __init__(
        self,
        net: CVAE | CosineCVAE,
        config: CVAETraining,
        steps: int,
        weights: Tensor | None = None,
    ):
        self.net, self.config, self.steps, self.weights = net, config, steps, weights
        self.half = config.products == "bfloat16" or (config.products == "auto" and bfloat16_is_fast())
        self.optimizers: dict[str, Optimizer] = {"net": Adam(net.parameters(), lr=config.lr)}

    def modules(self) -> Mapping[str, torch.nn.Module]:
        """What is trained, by name."""
        return {"net": self.net}

    def step(self, sampler: PackedFrames, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        """One update; the parts of the loss."""
        c, p, f = self.config, self.net.config.past, self.net.config.future
        segments, stride = 1, f
        if c.segments > 1 and bool(torch.rand((), generator=generator) < c.own_past):
            segments = int(torch.randint(2, c.segments + 1, (), generator=generator))
            if c.shorter and f >= 2 * p and bool(torch.rand((), generator=generator) < 0.5):
                stride = f // 2
        while segments > 1 and not c.shorter and not sampler.count(p + segments * f):
            segments -= 1
        whole = p + (segments - 1) * stride + f
        starts = sampler.starts(c.batch, p + f if c.shorter else whole, generator)
        room, x = sampler.room[starts], self.net.scaled(sampler.taken(starts, whole))
        past = self.disturbed(x[:, :p], generator)
        losses, sizes, parts = list[Tensor](), list[int](), dict[str, Tensor]()
        for at in range(0, segments * stride, stride):
            goes_on = room >= at + p + f
            if not bool(goes_on.any()):
                break
            x, past, room = x[goes_on], past[goes_on], room[goes_on]
            future = settling(past, x[:, at : at + p], x[:, at + p : at + p + f], c.settle)
            loss, of_it, made = self.loss(past, future, generator)
            losses.append(loss)
            sizes.append(len(x))
            parts |= of_it if at == 0 else {f"own_{n}": v for n, v in of_it.items()}
            # What is no motion at all teaches nothing, and might grow from segment to segment.
            past = torch.cat((past, made[:, :stride].detach().clamp(-FAR, FAR)), 1)[:, -p:]
        share = torch.tensor(sizes) / max(sizes)
        loss = (torch.stack(losses) * share).mean() / share.mean()
        optimizer = self.optimizers["net"]
        for group in optimizer.param_groups:
            group["lr"] = c.lr * falling(step, self.steps, c.held)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), c.grad_norm, foreach=True)
        optimizer.step()
        return {**parts, "loss": loss.detach()}

    def disturbed(self, past: Tensor, rng: torch.Generator) -> Tensor:
        """Pasts `(N, p, D)` that are off, by another one's share and by noise."""
        c, n = self.config, len(past)
        if c.mix:
            share = (
                c.mix * torch.rand(n, 1, 1, generator=rng) * (torch.rand(n, 1, 1, generator=rng) < 0.5)
            )
            past = torch.lerp(past, past.roll(1, 0), share)
        if c.noise:
            past = past + c.noise * torch.randn(n, 1, past.shape[-1], generator=rng)
        return past

    def loss(
        self, past: Tensor, future: Tensor, rng: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        """The loss of one segment, its parts, and what was made `(N, f, D)`."""
        c = self.config
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            code = self.net.encode(past, future)
            made = self.net.decode(past, code.draw(rng)).float()
        code = Code(code.mean.float(), code.log_var.float())
        square = self._squares(made, future)
        divergence = code.divergence().mean()
        parts = {"square": square.detach(), "kl": divergence.detach()}
        loss = square + divergence.clamp_min(c.tolerance)
        if c.smooth:
            last = past[:, -1:]
            own, true = (torch.diff(torch.cat((last, x), 1), dim=1) for x in (made, future))
            rough = self._squares(own, true)
            parts["smooth"] = rough.detach()
            loss = loss + c.smooth * rough
        return loss, parts, made

    def _squares(self, made: Tensor, true: Tensor) -> Tensor:
        squares = (made - true).square()
        if self.weights is not None:
            squares = squares * self.weights
        return squares.sum() / len(made) / (2 * self.config.beta)


def settling(past: Tensor, true: Tensor, future: Tensor, settle: float) -> Tensor:
    """Futures `(N, f, D)` as they are to be after a past that is off from the true one `(N, p, D)`.

    An offset that is gone in a segment's first frame would be a jerk. The offset dies down as a
    critically damped spring does,

        x'(t) = x(t) + (o + (v + o / s) t) exp(-t / s)

    with o the last frame's offset from the truth, v its change in a frame, and s = `settle` frames.
    """
    off = past[:, -2:] - true[:, -2:]
    o, v = off[:, 1:], off[:, 1:] - off[:, :1]
    t = torch.arange(1, future.shape[1] + 1).to(future)[:, None]
    return future + (o + (v + o / settle) * t) * torch.exp(-t / settle)


def falling(step: int, steps: int, held: float) -> float:
    """The share of the step size: constant, then along a line to 0."""
    begin = held * steps
    return 1.0 if step < begin else max(0.0, (steps - step) / max(1.0, steps - begin))
