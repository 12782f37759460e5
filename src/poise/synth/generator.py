"""A kinematic policy as a generator: motion without end, from its own past or from another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.nets.cosine_cvae import CosineCVAE
from poise.nets.cvae import CVAE
from poise.synth.place_free import coordinates, past_features

#: Frames of a past, counted from its end, by which it is compared with others.
COMPARED = (-1, -5, -12)
#: How many of the most similar pasts a code is drawn from.
NEAREST = 8
#: Speed (m/s) from which on a character that walks can be turned as fast as `BEND` (rad/s) at most.
WALKS, BEND = 0.8, 0.7
#: Where one of several futures is to be chosen: one in so many is drawn as usual; the others are of ever
#: less similar pasts, each bent in so many ways.
USUAL, BENDS = 8, 3


@dataclass(frozen=True, eq=False)
class Codes:
    """What followed in the library, as codes: a prior that knows the past.

    With N(0, I), the paper's, half of what is drawn is between what people do, so that motion dies down.
    Here z is that of what once followed one of the most similar pasts, with its encoder's noise,

        p(z | past) = sum_i w_i q_i(z),  w_i ~ exp(-(d_i^2 - d_1^2) / (2 T^2 d_1^2)),

    with distances d_1 <= d_2 <= ... of pasts, and the temperature T, by which the noise is scaled, too.

    Attributes:
        keys: `(K, 3 D)` of pasts, see `key_of`.
        mean, log_var: `(K, Z)` of q.
        weights: `(D)` of a frame's numbers, in deviations.
        kinds: `(K,)` which label the motion has, -1 for none; None where there are no labels.
    """

    keys: Tensor
    mean: Tensor
    log_var: Tensor
    weights: Tensor
    kinds: Tensor | None = None

    def only(self, kind: int) -> Codes:
        """Those of one label."""
        assert self.kinds is not None
        rows = self.kinds == kind
        return Codes(self.keys[rows], self.mean[rows], self.log_var[rows], self.weights)

    def key_of(self, past: Tensor) -> Tensor:
        """`(N, 3 D)` of pasts `(N, p, D)` in deviations: some of their frames, weighted."""
        picks = [max(k, -past.shape[1]) for k in COMPARED]
        return (past[:, picks] * self.weights).flatten(1)

    def draw(self, past: Tensor, count: int, rng: torch.Generator, temperature: float) -> Tensor:
        """`(N * count, Z)`: so many codes for each of the pasts `(N, p, D)`, in deviations."""
        near, index = self._nearest(past, NEAREST)
        least = near[:, :1].square().clamp_min(1e-6)
        share = (-(near.square() - least) / (2 * max(temperature, 1e-3) ** 2 * least)).softmax(-1)
        picks = torch.multinomial(share, count, replacement=True, generator=rng)
        code = index.gather(1, picks).flatten()
        noise = torch.randn(len(code), self.mean.shape[1], generator=rng)
        return self.mean[code] + temperature * (0.5 * self.log_var[code]).exp() * noise

    def wide(self, past: Tensor, count: int) -> Tensor:
        """`(N * count, Z)`: the middles of the codes of the `count` most similar pasts, each once, over
        again where there are fewer."""
        index = self._nearest(past, count)[1]
        index = index[:, torch.arange(count) % index.shape[1]]
        return self.mean[index.flatten()]

    def _nearest(self, past: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Distances and numbers `(N, count)` of the most similar pasts, the nearest first."""
        apart = torch.cdist(self.key_of(past), self.keys)
        near, index = apart.topk(min(count, len(self.keys)), largest=False)
        return near, index


class Kinematic:
    """Makes the next segment of motion after the past one (Residual Force Control, section 5).

    Args:
        net: the trained kinematic policy.
        seeds: `(S, p, 7 + n)` pasts from which motions begin.
        fps: frames a second.
        temperature: deviation of z; below 1 motion is more usual, above it less.
        bounds: `(2, n)` rad, least and most of each hinge; None leaves angles as they are made.
        codes: from which z is drawn; None draws it from N(0, temperature^2), as the paper does.
    """

    def __init__(
        self,
        net: CVAE | CosineCVAE,
        seeds: Tensor,
        fps: float,
        temperature: float = 1.0,
        bounds: Tensor | None = None,
        codes: Codes | None = None,
    ):
        if seeds.ndim != 3 or seeds.shape[1] != net.config.past or not len(seeds):
            raise PoiseError(
                f"seeds must be pasts of {net.config.past} frames, got {tuple(seeds.shape)}", "Kinematic"
            )
        if not temperature >= 0:
            raise PoiseError(f"the temperature must be at least 0, got {temperature:g}")
        self.net, self.seeds, self.fps = net.eval(), seeds.double(), fps
        self.temperature, self.bounds, self.codes = temperature, bounds, codes
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
        """`(n, count, future, 7 + n)`: several futures of each past. One alone is drawn as usual. Of
        more, one in `USUAL` is; the others are what followed the most similar pasts, as many as there is
        room for, bent to either side as far as the character walks: somewhere to go is not left to
        chance."""
        own = past_features(past.double(), self.fps).float()
        usual = -(-count // USUAL)
        kinds = -(-(count - usual) // BENDS)
        frames = own.repeat_interleave(usual + kinds, 0)
        made = self.net.continued(frames, self._codes(own, usual, kinds, rng)).double()
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

    def _codes(self, past: Tensor, usual: int, kinds: int, rng: torch.Generator) -> Tensor:
        """`(N (usual + kinds), Z)` after pasts `(N, p, 10 + n)`."""
        if self.codes is None:
            return self.net.draw(len(past) * (usual + kinds), rng, self.temperature)
        scaled = self.net.scaled(past)
        drawn = self.codes.draw(scaled, usual, rng, self.temperature)
        if not kinds:
            return drawn
        parts = drawn, self.codes.wide(scaled, kinds)
        return torch.cat([z.unflatten(0, (len(past), -1)) for z in parts], 1).flatten(0, 1)

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
        parts, have = [made], self.past
        while have < self.past + frames:
            made = self.generate(made[:, -self.past :], one, rng)
            parts.append(made)
            have += self.future
            made = torch.cat(parts[-2:], 1)
        return torch.cat(parts, 1)[0, : self.past + frames]
