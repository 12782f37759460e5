"""How a kinematic policy is learned: the evidence lower bound of Residual Force Control's Eq. 6.

    L = |x - x~|^2 / (2 beta) + max(KL(q(z | x) || N(0, I)), tolerance)

with squares of numbers in deviations, summed over a future. Its own past (Algorithm 1, line 11) is what
a policy sees after the first segment, so it learns from that, too: in a share of the batches further
segments follow those that it made. What is off at a segment's beginning is not to be gone in its first
frame, which would jerk; it dies down as a critically damped spring does,

    x'(t) = x(t) + (o + (v + o / s) t) exp(-t / s)

with o the last frame's offset from the truth, v its change in a frame, and s frames. A past that is
partly of another window teaches the same: the way back to motion that there is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.nets.cosine_cvae import CosineCVAE
from poise.nets.cvae import CVAE, Code
from poise.nets.mlp import bfloat16_is_fast
from poise.settings import validate

#: Deviations beyond which numbers of its own past are no motion.
FAR = 8.0


@dataclass(frozen=True)
class CVAETraining:
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

    batch: int = 128
    lr: float = 5e-4
    held: float = 0.5
    beta: float = 10.0
    tolerance: float = 20.0
    smooth: float = 10.0
    own_past: float = 0.7
    segments: int = 3
    shorter: bool = False
    noise: float = 0.05
    mix: float = 0.4
    settle: float = 5.0
    grad_norm: float = 1.0
    products: Literal["auto", "float32", "bfloat16"] = "auto"

    def __post_init__(self) -> None:
        validate(self)
        above = (self.batch, self.lr, self.beta, self.settle, self.segments, self.grad_norm)
        if min(above) <= 0:
            raise PoiseError(
                "batch, lr, beta, settle, segments and grad_norm must be above 0", "CVAETraining"
            )

    @classmethod
    def paper(cls) -> CVAETraining:
        """200 epochs at a constant step size and 800 in which it falls; minibatches of 256. An epoch's
        batch is 10,000 windows, so that the whole is 40,000 steps."""
        return cls(batch=256, lr=1e-3, held=0.2, tolerance=10.0, smooth=0.0, own_past=0.0,
                   segments=1, noise=0.0, mix=0.0, grad_norm=1e9, products="float32")  # fmt: skip


class Frames:
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
                f"no clip has {window} frames in a row", hint="Give longer clips, or see fewer frames"
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
    """Loss and update of a kinematic policy; see `learn.inbetween.InbetweenTrainer`.

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
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "net": torch.optim.Adam(net.parameters(), lr=config.lr, fused=True)
        }

    def modules(self) -> Mapping[str, torch.nn.Module]:
        """What is trained, by name."""
        return {"net": self.net}

    def step(self, sampler: Frames, step: int, generator: torch.Generator) -> dict[str, Tensor]:
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
    """Futures `(N, f, D)` as they are to be after a past that is off from the true one `(N, p, D)`."""
    off = past[:, -2:] - true[:, -2:]
    o, v = off[:, 1:], off[:, 1:] - off[:, :1]
    t = torch.arange(1, future.shape[1] + 1).to(future)[:, None]
    return future + (o + (v + o / settle) * t) * torch.exp(-t / settle)


def falling(step: int, steps: int, held: float) -> float:
    """The share of the step size: constant, then along a line to 0."""
    begin = held * steps
    return 1.0 if step < begin else max(0.0, (steps - step) / max(1.0, steps - begin))
