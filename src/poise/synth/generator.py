"""A kinematic policy as a generator: motion without end, from its own past or from another."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.nets.cosine_cvae import CosineCVAE
from poise.nets.cvae import CVAE
from poise.synth.codes import Codes
from poise.synth.place_free import coordinates, past_features
from poise.synth.wishes import Wishes

#: Speed (m/s) from which on a character that walks can be turned as fast as `BEND` (rad/s) at most.
WALKS, BEND = 0.8, 0.7
#: Where one of several futures is to be chosen: one in so many is drawn as usual; the others are of ever
#: less similar pasts, each bent in so many ways.
USUAL, BENDS = 8, 3


class Kinematic:
    """Makes the next segment of motion after the past one (Residual Force Control, section 5).

    Args:
        net: the trained kinematic policy.
        seeds: `(S, p, 7 + n)` pasts from which motions begin.
        fps: frames a second.
        temperature: deviation of z; below 1 motion is more usual, above it less.
        bounds: `(2, n)` rad, least and most of each hinge; None leaves angles as they are made.
        codes: from which z is drawn; None draws it from N(0, temperature^2), as the paper does.
        wishes: what labels worlds keep to for a while; None leaves that to chance, see `wishing`.
    """

    def __init__(
        self,
        net: CVAE | CosineCVAE,
        seeds: Tensor,
        fps: float,
        temperature: float = 1.0,
        bounds: Tensor | None = None,
        codes: Codes | None = None,
        wishes: Wishes | None = None,
    ):
        if seeds.ndim != 3 or seeds.shape[1] != net.config.past or not len(seeds):
            raise PoiseError(
                f"seeds must be pasts of {net.config.past} frames, got {tuple(seeds.shape)}", "Kinematic"
            )
        if not temperature >= 0:
            raise PoiseError(f"the temperature must be at least 0, got {temperature:g}")
        self.net, self.seeds, self.fps = net.eval(), seeds.double(), fps
        self.temperature, self.bounds, self.codes, self.wishes = temperature, bounds, codes, wishes
        self.past, self.future = net.config.past, net.config.future

    def wishing(self, seconds: float, worlds: int = 1) -> Kinematic:
        """The same for some worlds, each of which keeps to a label of the library for some seconds, on
        average, and then turns to another one; no seconds or no labels leave that to chance."""
        segments = seconds * self.fps / self.future
        wishes = Wishes.among(self.codes, segments, worlds) if seconds > 0 else None
        return Kinematic(
            self.net, self.seeds, self.fps, self.temperature, self.bounds, self.codes, wishes
        )

    def begin(self, count: int, rng: torch.Generator) -> Tensor:
        """`(count, past, 7 + n)` of the seeds, drawn evenly, set to the origin."""
        frames = self.seeds[torch.randint(len(self.seeds), (count,), generator=rng)].clone()
        frames[..., :2] -= frames[:, -1:, :2].clone()
        return frames

    def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        """`(n, future, 7 + n)` after `past (n, past, 7 + n)`."""
        return self.propose(past, rng, 1, ids)[:, 0]

    @torch.no_grad()
    def propose(
        self, past: Tensor, rng: torch.Generator, count: int, ids: Tensor | None = None
    ) -> Tensor:
        """`(n, count, future, 7 + n)`: several futures of each past, as worlds `ids (n,)` wish, if they
        are told. One alone is drawn as usual. Of more, one in `USUAL` is; the others are what followed
        the most similar pasts, as many as there is room for, bent to either side as far as the character
        walks: somewhere to go is not left to chance."""
        own = past_features(past.double(), self.fps).float()
        usual = -(-count // USUAL)
        kinds = -(-(count - usual) // BENDS)
        frames = own.repeat_interleave(usual + kinds, 0)
        made = self.net.continued(frames, self._codes(own, usual, kinds, rng, ids)).double()
        made = made.unflatten(0, (len(past), -1))
        bend = torch.linspace(-BEND, BEND, BENDS).double().repeat(kinds)[: count - usual]
        bent = made[:, usual:].repeat_interleave(BENDS, 1)[:, : count - usual].clone()
        pace = (bent[..., :2].norm(dim=-1) / WALKS).clamp_max(1.0)
        bent[..., 2] += bend[:, None] * pace
        made = torch.cat((made[:, :usual], bent), 1).flatten(0, 1)
        last = past[:, -1].double().repeat_interleave(count, 0)
        out = coordinates(made, last, self.fps)
        if self.bounds is not None:
            low, high = self.bounds
            out[..., 7:] = out[..., 7:].clamp(low, high)
        return out.unflatten(0, (len(past), count))

    def _codes(
        self, past: Tensor, usual: int, kinds: int, rng: torch.Generator, ids: Tensor | None
    ) -> Tensor:
        """`(N (usual + kinds), Z)` after pasts `(N, p, 10 + n)`."""
        if self.codes is None:
            return self.net.draw(len(past) * (usual + kinds), rng, self.temperature)
        scaled, label = self.net.scaled(past), None
        if self.wishes is not None and ids is not None:
            label = self.wishes.next(scaled, ids, rng)
        drawn = self.codes.draw(scaled, usual, rng, self.temperature, label)
        if not kinds:
            return drawn
        parts = drawn, self.codes.wide(scaled, kinds, label)
        return torch.cat([z.unflatten(0, (len(past), -1)) for z in parts], 1).flatten(0, 1)

    def rows(self) -> Mapping[str, Tensor]:
        """What worlds wish; else it remembers nothing but the past that it is given."""
        return {} if self.wishes is None else self.wishes.rows()

    def endless(self, frames: int, rng: torch.Generator, past: Tensor | None = None) -> Tensor:
        """`(past + frames, 7 + n)` of one motion without physics, its own past again and again.

        past: `(p, 7 + n)` from which it begins; by default one of the seeds.
        """
        one = torch.zeros(1, dtype=torch.long)
        made = self.begin(1, rng) if past is None else past[None].double()
        if made.shape[1] != self.past:
            raise PoiseError(f"a past has {self.past} frames, got {made.shape[1]}")
        parts, have = [made], self.past
        while have < self.past + frames:
            made = self.generate(made[:, -self.past :], one, rng)
            parts.append(made)
            have += self.future
            made = torch.cat(parts[-2:], 1)
        return torch.cat(parts, 1)[0, : self.past + frames]
