"""One training step of the recurrent transition network, generator and critics (Harvey et al. 2020)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from poise.learn.between import schedule
from poise.learn.frames import Sampler, Windows
from poise.nets.mlp import bfloat16_is_fast
from poise.nets.rtn import RTN, Critic, Steps
from poise.nets.transition import Known, continued, into_place, joint_positions, place_of


@dataclass(frozen=True)
class RTNTraining:
    """How the recurrent network is trained; the paper's values where it or its re-implementations
    state them."""

    batch: int = 64
    """The paper's 32 may be meant for more steps; 64 uses a processor a fifth better."""
    lr: float = 1e-3
    """AMSGrad with betas (0.5, 0.9)."""
    decay: bool = True
    """Whether the step size falls as a cosine to the end; the paper keeps it constant, but trains
    for days."""
    shortest: int = 5
    ramp: float = 0.5
    """Share of the steps over which the longest transition grows from `shortest` to P_max."""
    quat: float = 1.0
    pos: float = 1.0
    root: float = 0.5
    contact: float = 0.1
    adversarial: float = 0.1
    slide: float = 0.1
    """alpha of Skeleton2Humanoid's Eq. 3, contacts detached; 0 trains as Harvey et al. do."""
    equalise: bool = True
    """Each loss is first divided by what it is for the untrained network, as the paper has it; without,
    the critics' verdict is 85 % of the sum."""
    grad_norm: float = 1.0
    products: Literal["auto", "float32", "bfloat16"] = "auto"
    """How matrices are multiplied; states, losses and weights are float32 in any case."""


#: The parts of the generator's loss.
LOSSES = ("quat", "pos", "root", "contact", "adversarial", "slide")


class Scales(torch.nn.Module):
    """What losses are divided by: their values when they were first asked for; 0 before."""

    first: Tensor

    def __init__(self, count: int):
        super().__init__()
        self.register_buffer("first", torch.zeros(count))

    def of(self, losses: Tensor) -> Tensor:
        """The scales `(count,)`; the first `losses (count,)` settle them."""
        if not bool(self.first.any()):
            self.first.copy_(losses.clamp_min(1e-6))
        return self.first


class RTNObjective:
    """Loss and update of an `RTN` and its two critics; see `learn.inbetween.InbetweenTrainer`."""

    def __init__(
        self, net: RTN, config: RTNTraining, std: Tensor, steps: int, generator: torch.Generator
    ):
        self.net, self.config, self.std, self.steps = net, config, std, steps
        channels = 6 * net.layout.joints
        self.critics = torch.nn.ModuleList(
            [Critic(channels, window, generator=generator) for window in (10, 2)]
        )
        self.scales = Scales(len(LOSSES))
        self.half = config.products == "bfloat16" or (config.products == "auto" and bfloat16_is_fast())
        kind = {"lr": config.lr, "betas": (0.5, 0.9), "amsgrad": True}
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "net": torch.optim.Adam(net.parameters(), **kind),
            "critics": torch.optim.Adam(self.critics.parameters(), **kind),
        }

    def modules(self) -> Mapping[str, torch.nn.Module]:
        """What is trained, by name."""
        return {"net": self.net, "critics": self.critics, "scales": self.scales}

    def longest(self, step: int) -> int:
        """P_cur, the longest transition at a step: from `shortest` to P_max along a line."""
        c, most = self.config, self.net.config.longest
        share = min(1.0, step / max(1.0, c.ramp * self.steps))
        return round(c.shortest + share * (most - c.shortest))

    def step(self, sampler: Sampler, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        """One update of the critics and of the generator; the parts of the loss."""
        c, past = self.config, self.net.config.past
        most = self.longest(step)
        while sampler.count(past + most + 1) == 0 and most > c.shortest:
            most -= 1
        length = int(torch.randint(c.shortest, max(c.shortest, most) + 1, (), generator=generator))
        batch = sampler.draw(c.batch, past + length + 1, generator)
        share = schedule(step, 1, self.steps) if c.decay else 1.0
        for optimizer in self.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = c.lr * share
        batch = self._placed(batch)
        goal = continued(batch.rot[:, -1:], batch.rot[:, past - 1])[:, 0]
        known = Known(batch.root[:, :past], batch.rot[:, :past], batch.root[:, -1], goal, batch.offsets)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            steps = self.net(known, length, self.net.draw(c.batch, generator))
        truth = joint_positions(self.net.layout, batch.offsets, batch.root, batch.rot)
        pos = joint_positions(self.net.layout, batch.offsets, steps.root, steps.rot)
        real = self.channels(batch.root, truth)
        fake_root = torch.cat((batch.root[:, :past], steps.root, batch.root[:, -1:]), 1)
        fake = self.channels(fake_root, torch.cat((truth[:, :past], pos, truth[:, -1:]), 1))
        judged = self._judge(real, fake.detach())
        loss, parts = self.loss(steps, pos, batch, truth, fake)
        self._update("net", loss, list(self.net.parameters()))
        return {**parts, "critics": judged, "loss": loss.detach(), "longest": torch.tensor(float(most))}

    def loss(
        self, steps: Steps, pos: Tensor, batch: Windows, truth: Tensor, fake: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """L1 of local quaternions, root, positions and contacts, the critics' verdict, Eq. 3's slide;
        the parts that are returned are as they are, before they are made equal."""
        past, c = self.net.config.past, self.config
        gap = slice(past, past + steps.root.shape[1])
        feet = list(self.net.layout.feet)
        path = torch.cat((truth[:, past - 1 : past], pos), 1)[:, :, feet]
        moved = (torch.diff(path, dim=1).square().sum(-1) + 1e-10).sqrt()
        verdict = sum(((x - 1).square().mean() for x in self._verdicts(fake)), torch.zeros(()))
        parts = {
            "quat": functional.l1_loss(steps.rot, batch.rot[:, gap]),
            "pos": ((pos - truth[:, gap]) / self.std).abs().mean(),
            "root": ((steps.root - batch.root[:, gap]) / self.std[0]).abs().mean(),
            "contact": functional.l1_loss(steps.contact, batch.contact[:, gap]),
            "adversarial": 0.5 * verdict,
            "slide": 100 * (moved * steps.contact.detach()).mean(),
        }
        if c.equalise:
            scales = self.scales.of(torch.stack([parts[k].detach() for k in LOSSES]))
            weighted = (getattr(c, k) * parts[k] / scales[i] for i, k in enumerate(LOSSES))
        else:
            weighted = (getattr(c, k) * v for k, v in parts.items())
        total = sum(weighted, torch.zeros(()))
        return total, {k: v.detach() for k, v in parts.items()}

    def _judge(self, real: Tensor, fake: Tensor) -> Tensor:
        """One step of both critics: 1 for recorded motion, 0 for generated (LSGAN)."""
        both = zip(self._verdicts(real), self._verdicts(fake), strict=True)
        parts = (0.5 * ((a - 1).square() + b.square()).mean() for a, b in both)
        loss = sum(parts, torch.zeros(()))
        self._update("critics", loss, list(self.critics.parameters()))
        return loss.detach()

    def _verdicts(self, frames: Tensor) -> list[Tensor]:
        """What each critic says of sequences, float32 `(N)` each."""
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            return [critic(frames).float() for critic in self.critics]

    def _update(self, name: str, loss: Tensor, params: list[torch.nn.Parameter]) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(params, self.config.grad_norm, foreach=True)
        optimizer.step()

    def channels(self, root: Tensor, pos: Tensor) -> Tensor:
        """What critics see `(N, T, 6 J)`: positions about the root's ground point, and velocities."""
        ground = root * torch.tensor([1.0, 1.0, 0.0])
        about = (pos - ground.unsqueeze(-2)) / self.std.mean()
        speed = torch.diff(pos, dim=1) / self.net.velocity_std.mean()
        speed = torch.cat((speed[:, :1], speed), 1)
        return torch.cat((about.flatten(-2), speed.flatten(-2)), -1)

    def _placed(self, batch: Windows) -> Windows:
        at = self.net.config.past - 1
        place = place_of(batch.root[:, at], batch.rot[:, at], self.net.layout.facing)
        root, rot = into_place(batch.root, batch.rot, place)
        # One sign for a whole window, since its quaternions are continuous.
        return batch._replace(root=root, rot=rot * self.net.signs(rot[:, at]).unsqueeze(1))
