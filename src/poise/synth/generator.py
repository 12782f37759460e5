"""A kinematic policy as a generator: motion without end, from its own past or from another."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.nets.cvae import CVAE
from poise.synth.place_free import coordinates, past_features


class Kinematic:
    """Makes the next segment of motion after the past one (Residual Force Control, section 5).

    Args:
        net: the trained kinematic policy.
        seeds: `(S, p, 7 + n)` pasts from which motions begin.
        fps: frames a second.
        temperature: deviation of z; below 1 motion is more usual, above it less.
        bounds: `(2, n)` rad, least and most of each hinge; None leaves angles as they are made.
    """

    def __init__(
        self,
        net: CVAE,
        seeds: Tensor,
        fps: float,
        temperature: float = 1.0,
        bounds: Tensor | None = None,
    ):
        if seeds.ndim != 3 or seeds.shape[1] != net.config.past or not len(seeds):
            raise PoiseError(
                f"seeds must be pasts of {net.config.past} frames, got {tuple(seeds.shape)}", "Kinematic"
            )
        if not temperature >= 0:
            raise PoiseError(f"the temperature must be at least 0, got {temperature:g}")
        self.net, self.seeds, self.fps = net.eval(), seeds.double(), fps
        self.temperature, self.bounds = temperature, bounds
        self.past, self.future = net.config.past, net.config.future

    def begin(self, count: int, rng: torch.Generator) -> Tensor:
        """`(count, past, 7 + n)` of the seeds, drawn evenly, set to the origin."""
        frames = self.seeds[torch.randint(len(self.seeds), (count,), generator=rng)].clone()
        frames[..., :2] -= frames[:, -1:, :2].clone()
        return frames

    @torch.no_grad()
    def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        """`(n, future, 7 + n)` after `past (n, past, 7 + n)`."""
        frames = past_features(past.double(), self.fps).float()
        z = self.net.draw(len(past), rng, self.temperature)
        made = coordinates(self.net.continued(frames, z).double(), past[:, -1].double(), self.fps)
        if self.bounds is not None:
            low, high = self.bounds
            made[..., 7:] = made[..., 7:].clamp(low, high)
        return made

    def rows(self) -> Mapping[str, Tensor]:
        """It remembers nothing but the past that it is given."""
        return {}

    def endless(self, frames: int, rng: torch.Generator, past: Tensor | None = None) -> Tensor:
        """`(past + frames, 7 + n)` of one motion without physics, its own past again and again.

        past: `(p, 7 + n)` from which it begins; by default one of the seeds.
        """
        one = torch.zeros(1, dtype=torch.long)
        made = self.begin(1, rng) if past is None else past[None].double()
        if made.shape[1] != self.past:
            raise PoiseError(f"a past has {self.past} frames, got {made.shape[1]}")
        while made.shape[1] < self.past + frames:
            made = torch.cat((made, self.generate(made[:, -self.past :], one, rng)), 1)
        return made[0, : self.past + frames]
