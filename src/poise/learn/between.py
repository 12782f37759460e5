"""One training step of the transformer: which frames are hidden, and what is asked of the result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from poise.learn.frames import Sampler, Windows
from poise.nets.between import Between, Dropout, Gap
from poise.nets.mlp import bfloat16_is_fast
from poise.nets.transition import into_place, place_of
from poise.spatial import matrix_kinematics, quat_to_matrix

#: ||R_hat - R||_F = 2 sqrt(2) sin(angle / 2) per joint, and ||q_hat - q|| = 2 sin(angle / 4).
_AS_QUAT = 8**-0.5


@dataclass(frozen=True)
class BetweenTraining:
    """How the transformer is trained."""

    batch: int = 64
    lr: float = 1e-3
    warmup: int = 200
    """Steps over which the step size grows to `lr`; then it falls as a cosine to a hundredth."""
    weight_decay: float = 0.01
    past: int = 10
    shortest: int = 1
    longest: int = 60
    usual: int = 45
    """Of the lengths, those up to `usual` are drawn 85 % of the time."""
    whole_past: float = 0.7
    """Share of batches with the protocol's own context: `past` frames before, one keyframe after."""
    inner: float = 0.15
    """Share of batches with one or two known frames inside the gap."""
    coded: float = 0.2
    """Share of batches in which the code of variants is learned."""
    quat: float = 1.0
    pos: float = 1.0
    velocity: float = 1.0
    contact: float = 0.1
    slide: float = 5.0
    kl: float = 0.01
    grad_norm: float = 1.0
    dropout: float = 0.0
    """Share of the channels that each layer's branches miss, for small libraries."""
    products: Literal["auto", "float32", "bfloat16"] = "auto"


class BetweenObjective:
    """Loss and update of a `Between` network; see `learn.inbetween.InbetweenTrainer`."""

    def __init__(self, net: Between, config: BetweenTraining, std: Tensor, steps: int):
        self.net, self.config, self.std, self.steps = net, config, std, steps
        decayed = [p for p in net.parameters() if p.ndim > 1]
        plain = [p for p in net.parameters() if p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": config.weight_decay},
                  {"params": plain, "weight_decay": 0.0}]  # fmt: skip
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "net": torch.optim.AdamW(groups, lr=config.lr, betas=(0.9, 0.98), fused=True)
        }
        self.half = config.products == "bfloat16" or (config.products == "auto" and bfloat16_is_fast())

    def modules(self) -> Mapping[str, torch.nn.Module]:
        """What is trained, by name."""
        return {"net": self.net}

    def step(self, sampler: Sampler, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        """One update; the parts of the loss."""
        c = self.config
        hidden, window = self.mask(generator)
        while sampler.count(window) == 0 and len(hidden) > 12:
            hidden, window = self.mask(generator)
        batch = sampler.draw(c.batch, window, generator)
        optimizer = self.optimizers["net"]
        for group in optimizer.param_groups:
            group["lr"] = c.lr * schedule(step, c.warmup, self.steps)
        coded = bool(torch.rand((), generator=generator) < c.coded) and self.net.config.latent > 0
        drop = Dropout(c.dropout, generator) if c.dropout else None
        loss, parts = self.loss(batch, ~hidden, generator if coded else None, drop)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), c.grad_norm, foreach=True)
        optimizer.step()
        return {**parts, "loss": loss.detach(), "grad_norm": norm.detach()}

    def mask(self, generator: torch.Generator) -> tuple[Tensor, int]:
        """Which frames of a batch are hidden `(W)`, the same for all its windows, and W."""
        c = self.config

        def pick(low: int, high: int) -> int:
            return int(torch.randint(low, max(low, high) + 1, (), generator=generator))

        often, whole, inside = torch.rand(3, generator=generator).tolist()
        usual = min(c.usual, c.longest)
        length = pick(c.shortest, usual) if often < 0.85 else pick(min(usual + 1, c.longest), c.longest)
        past, after = (c.past, 1) if whole < c.whole_past else (pick(1, c.past), pick(1, c.past))
        hidden = torch.zeros(past + length + after, dtype=torch.bool)
        hidden[past : past + length] = True
        if inside < c.inner and length > 8:
            for _ in range(pick(1, 2)):
                hidden[past + pick(2, length - 3)] = False
        return hidden, len(hidden)

    def loss(
        self,
        batch: Windows,
        known: Tensor,
        coded: torch.Generator | None,
        drop: Dropout | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of one batch, and its parts.

        coded: draws the code of what happened in the gap, so that the network learns variants.
        """
        at = int((~known).nonzero()[0]) - 1
        place = place_of(batch.root[:, at], batch.rot[:, at], self.net.layout.facing)
        root, rot = into_place(batch.root, batch.rot, place)
        code, parts, total = None, {}, torch.zeros(())
        if coded is not None:
            mean, log_var = self.net.encode(root, rot, batch.offsets, (~known).nonzero()[:, 0])
            draw = torch.randn(mean.shape, generator=coded)
            code = mean + (0.5 * log_var).exp() * draw
            parts["kl"] = 0.5 * (mean.square() + log_var.exp() - 1 - log_var).sum(-1).mean()
            total = total + self.config.kl * parts["kl"]
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            first, refined = self.net(root, rot, known, batch.offsets, code, drop)
        truth = matrix_kinematics(
            self.net.layout.parents, batch.offsets.unsqueeze(1), root, quat_to_matrix(rot)
        )
        for name, gap in (("", first), ("refined_", refined)):
            if gap is not None:
                own = self._parts(gap, truth, batch, known)
                total = total + sum(getattr(self.config, k) * v for k, v in own.items())
                parts |= {f"{name}{k}": v for k, v in own.items()}
        return total, {k: v.detach() for k, v in parts.items()}

    def _parts(
        self, gap: Gap, truth: tuple[Tensor, Tensor], batch: Windows, known: Tensor
    ) -> dict[str, Tensor]:
        layout, hidden = self.net.layout, ~known
        pos, mats = matrix_kinematics(layout.parents, batch.offsets.unsqueeze(1), gap.root, gap.mats)
        error = (pos - truth[0]) / self.std
        steps = hidden[1:] | hidden[:-1]
        logits, labels = gap.contact[:, hidden], batch.contact[:, hidden]
        moved = torch.diff(pos[:, :, list(layout.feet)], dim=1)[:, steps].square().sum(-1)
        moved = (moved + 1e-8).sqrt()
        # A foot holds from one frame to the next where contact is predicted; the weights must not learn
        # to deny contact, so the probability is detached.
        held = (gap.contact.sigmoid().detach() * hidden[:, None] + batch.contact * known[:, None])[:, 1:]
        return {
            "pos": _stacked(error[:, hidden]),
            "quat": _AS_QUAT * _stacked((mats - truth[1])[:, hidden].flatten(-2)),
            "velocity": _stacked(torch.diff(error, dim=1)[:, steps]),
            "contact": functional.binary_cross_entropy_with_logits(logits, labels),
            "slide": (moved * held[:, steps]).mean(),
        }


def _stacked(error: Tensor) -> Tensor:
    """Mean over windows and frames of the norm over all joints and coordinates `(N, L, J, k)`."""
    return (error.square().sum((-2, -1)) + 1e-8).sqrt().mean()


def schedule(step: int, warmup: int, steps: int) -> float:
    """The share of the step size: a line up, then a cosine down to a hundredth."""
    if step < warmup:
        return (step + 1) / warmup
    done = min(1.0, (step - warmup) / max(1, steps - warmup))
    return 0.01 + 0.99 * 0.5 * (1 + float(torch.cos(torch.tensor(torch.pi * done))))
