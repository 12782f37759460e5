"""A network of the next frame as a generator: what a kinematic policy is compared with."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.nets.next_frame import NextFrame
from poise.synth.place_free import coordinates, past_features


class NextFrames:
    """Makes the next segment of motion frame by frame (`env.goals.generator.MotionGenerator`).

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
