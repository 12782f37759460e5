"""How networks of the next frame are learned: squares of what is off, in deviations."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from poise.learn.cvae import Frames
from poise.nets.next_frame import NextFrame

#: Norm to which gradients are scaled down.
_GRAD_NORM = 1.0


class NextFrameObjective:
    """Loss and update; see `learn.inbetween.InbetweenTrainer`.

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

    def step(self, sampler: Frames, step: int, generator: torch.Generator) -> dict[str, Tensor]:
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
