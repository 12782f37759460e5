"""A kinematic policy as a generator: motion without end, from its own past or from another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.cvae import CVAE, CosineCVAE
from poise.motion.rotations import (
    axis_angle_to_quat,
    heading_quat,
    matrix_to_quat,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_to_sixd,
    sixd_to_matrix,
    unwrap_quats,
)

#: Frames of a past, counted from its end, by which it is compared with others.
COMPARED = (-1, -5, -12)
#: How many of the most similar pasts a code is drawn from.
NEAREST = 8


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

    def draw(
        self,
        past: Tensor,
        count: int,
        rng: torch.Generator,
        temperature: float,
        kinds: Tensor | None = None,
    ) -> Tensor:
        """`(N * count, Z)`: so many codes for each of the pasts `(N, p, D)`, in deviations; of labels
        `kinds (N,)` alone, if they are given."""
        near, index = self._nearest(past, NEAREST, kinds)
        least = near[:, :1].square().clamp_min(1e-6)
        share = (-(near.square() - least) / (2 * max(temperature, 1e-3) ** 2 * least)).softmax(-1)
        picks = torch.multinomial(share, count, replacement=True, generator=rng)
        code = index.gather(1, picks).flatten()
        noise = torch.randn(len(code), self.mean.shape[1], generator=rng)
        return self.mean[code] + temperature * (0.5 * self.log_var[code]).exp() * noise

    def wide(self, past: Tensor, count: int, kinds: Tensor | None = None) -> Tensor:
        """`(N * count, Z)`: the middles of the codes of the `count` most similar pasts, each once, over
        again where there are fewer."""
        near, index = self._nearest(past, count, kinds)
        turn = torch.arange(count) % near.isfinite().sum(1, keepdim=True).clamp_min(1)
        return self.mean[index.gather(1, turn).flatten()]

    def apart(self, past: Tensor, labels: Tensor) -> Tensor:
        """`(N, L)`: how far each past is from the most similar one of each label."""
        apart = torch.cdist(self.key_of(past), self.keys)
        return torch.stack([apart[:, self.kinds == k].amin(1) for k in labels.tolist()], 1)

    def _nearest(self, past: Tensor, count: int, kinds: Tensor | None) -> tuple[Tensor, Tensor]:
        """Distances and numbers `(N, count)` of the most similar pasts, the nearest first; those of
        another label are infinitely far."""
        apart = torch.cdist(self.key_of(past), self.keys)
        if kinds is not None:
            assert self.kinds is not None
            apart = apart.masked_fill(self.kinds != kinds[:, None], torch.inf)
        near, index = apart.topk(min(count, len(self.keys)), largest=False)
        return near, index


#: Labels with fewer codes are not wished for.
FEWEST = 2 * NEAREST


@dataclass(eq=False)
class Wishes:
    """Each world keeps to a label for some segments, half as many to half as many again, and then turns
    to another one, rather to one with a past like its own:

        p(l) ~ exp(-(d_l^2 - d_1^2) / (2 d_1^2)),

    with the distance d_l of its past from the nearest one of each label, d_1 the least of them.

    Attributes:
        codes: of the library. labels: `(L,)` those that are wished for.
        segments: mean number of segments for which one is kept to.
        worlds: how many there are.
        kind, left: `(N,)` the label of each world, -1 before the first; segments that are left of it.
    """

    codes: Codes
    labels: Tensor
    segments: float
    worlds: int = 1
    kind: Tensor = field(init=False)
    left: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.kind = torch.full((self.worlds,), -1)
        self.left = torch.zeros_like(self.kind)

    @classmethod
    def among(cls, codes: Codes | None, segments: float, worlds: int = 1) -> Wishes | None:
        """Those for the labels of a library; None where it has fewer than two."""
        if codes is None or codes.kinds is None:
            return None
        kinds, counts = codes.kinds[codes.kinds >= 0].unique(return_counts=True)
        labels = kinds[counts >= FEWEST]
        return cls(codes, labels, segments, worlds) if len(labels) > 1 else None

    def next(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        """The labels `(n,)` of the segments that follow the pasts `(n, p, D)`, in deviations, of worlds
        `ids (n,)`."""
        turns = self.left[ids] <= 0
        some = ids[turns]
        if len(some):
            apart = self.codes.apart(past[turns], self.labels).square()
            apart[self.labels == self.kind[some, None]] = torch.inf
            least = apart.amin(1, keepdim=True)
            share = (-(apart - least) / (2 * least.clamp_min(1e-6))).softmax(1)
            self.kind[some] = self.labels[torch.multinomial(share, 1, generator=rng).squeeze(1)]
            low, high = (max(1, round(k * self.segments)) for k in (0.5, 1.5))
            self.left[some] = torch.randint(low, high + 1, (len(some),), generator=rng)
        self.left[ids] -= 1
        return self.kind[ids]

    def rows(self) -> dict[str, Tensor]:
        """What each world wishes."""
        return {"kind": self.kind, "left": self.left}


#: Numbers of a frame beside the hinges'.
ROOT = 10


def features_of(qpos: Tensor, fps: float) -> Tensor:
    """Frames `(T, 10 + n)` of coordinates `(T, 7 + n)`, which know no place and no heading.

    A frame is (v, w, z, r, q): the root's horizontal velocity in its own heading, m/s (2), the speed of
    its heading, rad/s (1), its height, m (1), its turn without heading, 6D (6), and the hinge angles,
    rad (n). Velocities are those from the frame before; the first frame moves as the second does.
    """
    root, turn = qpos[:, :3], qpos[:, 3:7]
    heading = heading_quat(turn)
    step = quat_rotate(quat_conj(heading[1:]), torch.diff(root, dim=0)) * fps
    move = quat_mul(quat_conj(heading[:-1]), heading[1:])
    speed = 2 * torch.atan2(move[:, 3:], move[:, :1])
    speed = (torch.remainder(speed + torch.pi, 2 * torch.pi) - torch.pi) * fps
    moving = torch.cat((step[:, :2], speed), -1)
    moving = torch.cat((moving[:1], moving))
    tilt = quat_to_sixd(quat_mul(quat_conj(heading), turn))
    return torch.cat((moving, root[:, 2:], tilt, qpos[:, 7:]), -1)


def past_features(qpos: Tensor, fps: float) -> Tensor:
    """The same of several pasts `(N, T, 7 + n)`."""
    return torch.stack([features_of(q, fps) for q in qpos])


def coordinates(frames: Tensor, last: Tensor, fps: float) -> Tensor:
    """Coordinates `(N, T, 7 + n)` of frames `(N, T, 10 + n)` that follow `last (N, 7 + n)`."""
    heading, at = heading_quat(last[:, 3:7]), last[:, :3]
    up = torch.tensor([0.0, 0.0, 1.0]).to(frames)
    tilt = matrix_to_quat(sixd_to_matrix(frames[..., 4:ROOT]))
    out: list[Tensor] = []
    for k in range(frames.shape[1]):
        f = frames[:, k]
        heading = quat_mul(heading, axis_angle_to_quat(up.expand(len(f), 3), f[:, 2] / fps))
        flat = torch.cat((f[:, :2], torch.zeros_like(f[:, :1])), -1)
        at = at + quat_rotate(heading, flat) / fps
        at = torch.cat((at[:, :2], f[:, 3:4]), -1)
        out.append(torch.cat((at, quat_mul(heading, tilt[:, k]), f[:, ROOT:]), -1))
    made = torch.stack(out, 1)
    turns = torch.cat((last[:, None, 3:7], made[..., 3:7]), 1)
    turns = torch.stack([unwrap_quats(q) for q in turns])[:, 1:]
    return torch.cat((made[..., :3], turns, made[..., 7:]), -1)


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
        latent: `(N, Z)`, into which z of each world's last segment is written, as a control policy sees
            it in Algorithm 1; None keeps none.
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
        latent: Tensor | None = None,
    ):
        if seeds.ndim != 3 or seeds.shape[1] != net.config.past or not len(seeds):
            raise PoiseError(
                f"seeds must be pasts of {net.config.past} frames, got {tuple(seeds.shape)}",
                "Kinematic",
                code="wrong-shape",
            )
        if not temperature >= 0:
            raise PoiseError(
                f"the temperature must be at least 0, got {temperature:g}", code="out-of-range"
            )
        self.net, self.seeds, self.fps = net.eval(), seeds.double(), fps
        self.temperature, self.bounds, self.codes, self.wishes = temperature, bounds, codes, wishes
        self.latent, self.past, self.future = latent, net.config.past, net.config.future

    def remembering(self, worlds: int) -> Kinematic:
        """The same for some worlds, of each of which it keeps z of the last segment, see `latent`."""
        own = self.net, self.seeds, self.fps, self.temperature, self.bounds, self.codes
        return Kinematic(*own, self.wishes, torch.zeros(worlds, self.net.config.latent))

    def wishing(self, seconds: float, worlds: int = 1) -> Kinematic:
        """The same for some worlds, each of which keeps to a label of the library for some seconds, on
        average, and then turns to another one; no seconds or no labels leave that to chance."""
        segments = seconds * self.fps / self.future
        wishes = Wishes.among(self.codes, segments, worlds) if seconds > 0 else None
        own = self.net, self.seeds, self.fps, self.temperature, self.bounds, self.codes
        return Kinematic(*own, wishes, self.latent)

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
        self,
        past: Tensor,
        rng: torch.Generator,
        count: int,
        ids: Tensor | None = None,
        usual: int | None = None,
    ) -> Tensor:
        """`(n, count, future, 7 + n)`: several futures of each past, as worlds `ids (n,)` wish, if they
        are told. So many are drawn as `usual`, by default one in `USUAL`; the others are what followed
        the most similar pasts, as many as there is room for, bent to either side as far as the character
        walks: somewhere to go is not left to chance."""
        own = past_features(past.double(), self.fps).float()
        usual = -(-count // USUAL) if usual is None else usual
        kinds = -(-(count - usual) // BENDS)
        frames = own.repeat_interleave(usual + kinds, 0)
        codes = self._codes(own, usual, kinds, rng, ids)
        if self.latent is not None and ids is not None and count == 1:
            self.latent[ids] = codes
        made = self.net.continued(frames, codes).double()
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
        """Labels that worlds wish, and z; else it remembers nothing but the past that it is given."""
        kept = {} if self.latent is None else {"latent": self.latent}
        return kept | ({} if self.wishes is None else self.wishes.rows())

    def endless(self, frames: int, rng: torch.Generator, past: Tensor | None = None) -> Tensor:
        """`(past + frames, 7 + n)` of one motion without physics, its own past again and again.

        past: `(p, 7 + n)` from which it begins; by default one of the seeds.
        """
        one = torch.zeros(1, dtype=torch.long)
        made = self.begin(1, rng) if past is None else past[None].double()
        if made.shape[1] != self.past:
            raise PoiseError(f"a past has {self.past} frames, got {made.shape[1]}", code="wrong-shape")
        parts, have = [made], self.past
        while have < self.past + frames:
            made = self.generate(made[:, -self.past :], one, rng)
            parts.append(made)
            have += self.future
            made = torch.cat(parts[-2:], 1)
        return torch.cat(parts, 1)[0, : self.past + frames]
