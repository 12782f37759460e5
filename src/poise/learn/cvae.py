"""How a kinematic policy is learned: the evidence lower bound of Residual Force Control's Eq. 6.

    L = |x - x~|^2 / (2 beta) + max(KL(q(z | x) || N(0, I)), tolerance)

with squares of numbers in deviations, summed over a future. Its own past (Algorithm 1, line 11) is what
a policy sees after the first segment, so it learns from that, too: in a share of the batches a second
segment follows the first one that it made.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from poise.errors import PoiseError
from poise.nets.cvae import CVAE, Code
from poise.nets.mlp import bfloat16_is_fast
from poise.settings import validate


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
        own_past: share of batches in which a second segment follows what was made of the first.
        noise: deviation of the noise on pasts, in deviations of the frames.
        grad_norm: gradients are scaled down to it.
        products: how matrices are multiplied; weights and losses are float32 in any case.
    """

    batch: int = 64
    lr: float = 1e-3
    held: float = 0.5
    beta: float = 10.0
    tolerance: float = 10.0
    smooth: float = 10.0
    own_past: float = 0.5
    noise: float = 0.05
    grad_norm: float = 1.0
    products: Literal["auto", "float32", "bfloat16"] = "auto"

    def __post_init__(self) -> None:
        validate(self)
        if min(self.batch, self.lr, self.beta, self.grad_norm) <= 0:
            raise PoiseError("batch, lr, beta and grad_norm must be above 0", "CVAETraining")

    @classmethod
    def paper(cls) -> CVAETraining:
        """200 epochs at a constant step size and 800 in which it falls; minibatches of 256. An epoch's
        batch is 10,000 windows, so that the whole is 40,000 steps."""
        return cls(batch=256, held=0.2, smooth=0.0, own_past=0.0, noise=0.0, grad_norm=1e9,
                   products="float32")  # fmt: skip


class Frames:
    """Windows of packed frames, drawn evenly.

    Args:
        frames: `(F, D)` of all clips, one after another.
        first: `(C + 1)` rows where clips begin.
    """

    def __init__(self, frames: Tensor, first: Tensor):
        self.frames, self.first = frames, first
        sizes = first[1:] - first[:-1]
        clip = torch.repeat_interleave(torch.arange(len(sizes)), sizes)
        self.room = first[1:][clip] - torch.arange(len(frames))

    def count(self, window: int) -> int:
        """How many different windows of `window` frames there are."""
        return int((self.room >= window).sum())

    def draw(self, count: int, window: int, generator: torch.Generator) -> Tensor:
        """`(count, window, D)`.

        Raises:
            PoiseError: no clip is long enough.
        """
        usable = (self.room >= window).nonzero()[:, 0]
        if not len(usable):
            raise PoiseError(
                f"no clip has {window} frames in a row", hint="Give longer clips, or see fewer frames"
            )
        start = usable[torch.randint(len(usable), (count,), generator=generator)]
        return self.frames[start[:, None] + torch.arange(window)]


class CVAEObjective:
    """Loss and update of a `CVAE`; see `learn.inbetween.InbetweenTrainer`.

    steps: of the whole training.
    """

    def __init__(self, net: CVAE, config: CVAETraining, steps: int):
        self.net, self.config, self.steps = net, config, steps
        self.half = config.products == "bfloat16" or (config.products == "auto" and bfloat16_is_fast())
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "net": torch.optim.Adam(net.parameters(), lr=config.lr)
        }

    def modules(self) -> Mapping[str, torch.nn.Module]:
        """What is trained, by name."""
        return {"net": self.net}

    def step(self, sampler: Frames, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        """One update; the parts of the loss."""
        c, size = self.config, self.net.config
        twice = bool(torch.rand((), generator=generator) < c.own_past)
        window = size.past + size.future * (2 if twice else 1)
        if twice and not sampler.count(window):
            twice, window = False, size.past + size.future
        x = self.net.scaled(sampler.draw(c.batch, window, generator))
        past, future = x[:, : size.past], x[:, size.past : size.past + size.future]
        past = past + c.noise * torch.randn(past.shape, generator=generator)
        loss, parts, made = self.loss(past, future, generator)
        if twice:
            own = torch.cat((past, made), 1)[:, -size.past :].detach()
            more, second, _ = self.loss(own, x[:, size.past + size.future :], generator)
            loss = 0.5 * (loss + more)
            parts |= {f"second_{k}": v for k, v in second.items()}
        optimizer = self.optimizers["net"]
        for group in optimizer.param_groups:
            group["lr"] = c.lr * falling(step, self.steps, c.held)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), c.grad_norm, foreach=True)
        optimizer.step()
        return {**parts, "loss": loss.detach()}

    def loss(
        self, past: Tensor, future: Tensor, rng: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        """The loss of one segment, its parts, and what was made `(N, f, D)`."""
        c = self.config
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            code = self.net.encode(past, future)
            made = self.net.decode(past, code.draw(rng)).float()
        code = Code(code.mean.float(), code.log_var.float())
        count = len(past)
        square = (made - future).square().sum() / count / (2 * c.beta)
        divergence = code.divergence().mean()
        parts = {"square": square.detach(), "kl": divergence.detach()}
        loss = square + divergence.clamp_min(c.tolerance)
        if c.smooth:
            last = past[:, -1:]
            own, true = (torch.diff(torch.cat((last, x), 1), dim=1) for x in (made, future))
            rough = functional.mse_loss(own, true, reduction="sum") / count / (2 * c.beta)
            parts["smooth"] = rough.detach()
            loss = loss + c.smooth * rough
        return loss, parts, made


def falling(step: int, steps: int, held: float) -> float:
    """The share of the step size: constant, then along a line to 0."""
    begin = held * steps
    return 1.0 if step < begin else max(0.0, (steps - step) / max(1.0, steps - begin))
