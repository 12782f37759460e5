"""A transformer that fills the unknown frames of a motion, and one training step of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from poise.errors import PoiseError
from poise.learn.adam import Adam, Optimizer
from poise.learn.networks import bfloat16_is_fast
from poise.learn.transition import (
    FilledGap,
    Known,
    SkeletonLayout,
    continued,
    into_place,
    out_of_place,
    place_of,
)
from poise.learn.window_sampler import Sampler, Windows
from poise.motion.rotations import (
    matrix_kinematics,
    matrix_to_quat,
    quat_to_matrix,
    quat_to_sixd,
    sixd_to_matrix,
)
from poise.motion.rotations import slerp as arc
from poise.settings import Count, validate

_MIN_STD = 0.02
#: Of steps from frame to frame.
_MIN_STEP = 0.002
#: Frames in which a speed dies away; of 2, 4, 8 and 16 the one with the least L2P at 5 frames on clips
#: of CMU to learn from (interpolation .629, then .516, .459, .441, .450).
_CARRIED = 8.0


@dataclass(frozen=True)
class BetweenConfig:
    """Sizes of the transformer; the defaults have about 5 million weights."""

    width: Count = 256
    layers: Count = 6
    heads: Count = 8
    feedforward: int = 1024
    refine: int = 0
    """Layers of the refining encoder; 0 leaves it out."""
    latent: int = 16
    """Size of the code that tells variants apart; drawn where `noise` is given, else absent."""
    reach: int = 80
    """Frames beyond which the learned bias of distances no longer changes."""
    speeds: bool = True
    """Whether interpolation goes on in the speed around it and frames are seen with their speeds."""

    def __post_init__(self) -> None:
        validate(self)
        if self.width % self.heads:
            raise PoiseError(
                f"width must be a multiple of heads, got {self.width} and {self.heads}",
                "BetweenConfig",
                code="not-a-multiple",
            )


class GapFrames(NamedTuple):
    """All frames `(N, T, ...)`, in the place of the last frame before the first gap; known frames are
    the given ones.

    Attributes:
        root: `(N, T, 3)` m.
        mats: `(N, T, J, 3, 3)` local rotation matrices.
        contact: `(N, T, F)` logits.
    """

    root: Tensor
    mats: Tensor
    contact: Tensor


class Dropout(NamedTuple):
    """Channels that a training step leaves out of each layer's branches.

    They are the same in all frames of a window, so that what is left does not tremble.

    Attributes:
        share: of the channels.
        generator: source of the draws.
    """

    share: float
    generator: torch.Generator

    def mask(self, h: Tensor) -> Tensor:
        """Factors `(N, 1, width)` of what a branch adds to `h (N, T, width)`."""
        keep = torch.rand(len(h), 1, h.shape[-1], generator=self.generator) >= self.share
        return keep.to(h) / (1 - self.share)


class Neighbours(NamedTuple):
    """The nearest known frames of every frame.

    Attributes:
        before: `(T)`, the nearest known frame before it.
        after: `(T)`, the nearest known frame after it.
        share: `(T)`, its place between them, 0 to 1.
    """

    before: Tensor
    after: Tensor
    share: Tensor


def neighbours(known: Tensor) -> Neighbours:
    """From `known (T)` bool; frames outside all known ones take the nearest one twice.

    Raises:
        PoiseError: no frame is known.
    """
    if not bool(known.any()):
        raise PoiseError("at least one frame must be known", code="no-known-frame")
    t = torch.arange(len(known), device=known.device)
    none = torch.full_like(t, -1)
    before = torch.where(known, t, none).cummax(0).values
    after = torch.where(known, t, none + len(known) + 1).flip(0).cummin(0).values.flip(0)
    before, after = (
        torch.where(before < 0, after, before),
        torch.where(after > len(known) - 1, before, after),
    )
    share = ((t - before) / (after - before).clamp_min(1)).clamp(0.0, 1.0) * (after > before)
    return Neighbours(before, after, share)


def carried(x: Tensor, known: Tensor, near: Neighbours) -> Tensor:
    """What interpolated frames gain when they go on in the speed of the known frames around the gap.

    t frames after the last known one, and s of the way to the next, the speed v before the gap in place
    of the interpolation's own u adds (v - u) t exp(-t / 8) (1 - s), and likewise from the other end.
    Nothing is added where only one frame is known on a side.

    Args:
        x: `(N, T, ...)` all frames, unknown ones interpolated.
        known: `(T)` bool.
    """
    last = len(known) - 1
    t = torch.arange(len(known), device=known.device)
    gap = ~known & (near.before < near.after)
    total = torch.zeros_like(x)
    for at, way, rest in ((near.before, 1, 1 - near.share), (near.after, -1, near.share)):
        past = at - way
        there = gap & (past >= 0) & (past <= last) & known[past.clamp(0, last)]
        u = x[:, (at + way).clamp(0, last)] - x[:, at]
        v = x[:, at] - x[:, past.clamp(0, last)]
        away = (t - at).abs().to(x)
        gain = away * torch.exp(-away / _CARRIED) * rest.to(x) * there.to(x)
        total = total + (v - u) * gain.view(-1, *(1,) * (x.dim() - 2))
    return total


class Between(nn.Module):
    """The network. Its first weights give interpolation.

    One encoder sees all frames at once: known frames as they are, unknown frames interpolated between
    their nearest known neighbours. The network corrects the interpolation (delta output: Oreshkin et al.
    2022), which goes on in the speed of the motion around the gap (`carried`). The network also sees the
    step of every frame from the one before: a speed is a small difference of large numbers, which a
    network that sees places alone hardly learns. Rotations are 6D columns, and all frames are seen from
    the last frame before the gap. The distances to both neighbouring keyframes and a learned bias per
    distance tell positions in time (Qin et al. 2022). There may be any number of keyframes, and any
    context. An optional second encoder refines the result of the first one.

    Args:
        layout: the skeleton.
        generator: source of the first weights.
    """

    feature_mean: Tensor
    feature_std: Tensor
    step_std: Tensor

    def __init__(
        self, layout: SkeletonLayout, config: BetweenConfig | None = None, *, generator: torch.Generator
    ):
        super().__init__()
        self.layout, self.config = layout, config or BetweenConfig()
        c, joints = self.config, layout.joints
        # Root, 6D rotations, joint positions about the root.
        self.features = 3 + 6 * joints + 3 * joints
        self.outputs = 3 + 6 * joints + len(layout.feet)
        self.register_buffer("feature_mean", torch.zeros(self.features))
        self.register_buffer("feature_std", torch.ones(self.features))
        seen = self.features
        if c.speeds:
            self.register_buffer("step_std", torch.ones(self.features))
            seen *= 2
        self.encoder = _Encoder(seen, self.outputs, c.layers, c, generator)
        more = seen + len(layout.feet)
        self.refiner = _Encoder(more, self.outputs, c.refine, c, generator) if c.refine else None
        if c.latent:
            self.posterior = nn.ModuleList(
                [
                    linear(seen, c.width, generator),
                    linear(c.width, 2 * c.latent, generator, 0.1),
                ]
            )
            self.code = linear(c.latent, c.width, generator)

    @torch.no_grad()
    def calibrate(self, root: Tensor, rot: Tensor, offsets: Tensor) -> None:
        """Takes the scale of every input from windows `(N, T, ...)`, seen from their middle frames."""
        middle = root.shape[1] // 3
        place = place_of(root[:, middle], rot[:, middle], self.layout.facing)
        own = self._features(*into_place(root, rot, place), offsets)
        x = own.flatten(0, 1)
        self.feature_mean.copy_(x.mean(0))
        self.feature_std.copy_(x.std(0).clamp_min(_MIN_STD))
        if self.config.speeds:
            steps = torch.diff(own, dim=1).flatten(0, 1)
            self.step_std.copy_(steps.square().mean(0).sqrt().clamp_min(_MIN_STEP))

    def _features(self, root: Tensor, rot: Tensor, offsets: Tensor) -> Tensor:
        return self._joined(root, quat_to_sixd(rot), quat_to_matrix(rot), offsets)

    def _joined(self, root: Tensor, sixd: Tensor, mats: Tensor, offsets: Tensor) -> Tensor:
        pos = matrix_kinematics(self.layout.parents, offsets.unsqueeze(1), torch.zeros_like(root), mats)[
            0
        ]
        return torch.cat((root, sixd.flatten(-2), pos.flatten(-2)), -1)

    def _seen(self, x: Tensor) -> Tensor:
        """What the network sees of features `(N, T, F)`, with their steps from the frame before."""
        own = (x - self.feature_mean) / self.feature_std
        if not self.config.speeds:
            return own
        steps = torch.diff(x, dim=1) / self.step_std
        return torch.cat((own, torch.cat((steps[:, :1], steps), 1)), -1)

    def draw(self, count: int, noise: torch.Generator) -> Tensor:
        """Codes `(count, latent)` of variants."""
        weight = self.code.weight
        return torch.randn(count, self.config.latent, generator=noise).to(weight)

    def encode(self, root: Tensor, rot: Tensor, offsets: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance `(N, latent)` of the code that tells what happened in frames `rows`."""
        x = self._seen(self._features(root, rot, offsets))
        hidden = functional.gelu(self.posterior[0](x[:, rows])).mean(1)
        return self.posterior[1](hidden).chunk(2, -1)

    def forward(
        self,
        root: Tensor,
        rot: Tensor,
        known: Tensor,
        offsets: Tensor,
        code: Tensor | None = None,
        drop: Dropout | None = None,
    ) -> tuple[GapFrames, GapFrames | None]:
        """All frames and, with a refiner, the refined ones.

        Args:
            root `(N, T, 3)`, rot `(N, T, J, 4)`: in the place of the last frame before the first gap;
                unknown frames are not looked at. known `(T)` bool, the same for all.
            offsets: `(N, J, 3)`.
            code: `(N, latent)` where a variant is asked for.
            drop: what a step of training leaves out.
        """
        near = neighbours(known)
        share = near.share.to(root)[:, None]
        root = root[:, near.before] + share * (root[:, near.after] - root[:, near.before])
        rot = arc(rot[:, near.before], rot[:, near.after], share)
        sixd, mats = quat_to_sixd(rot), quat_to_matrix(rot)
        if self.config.speeds:
            root, sixd = root + carried(root, known, near), sixd + carried(sixd, known, near)
            mats = torch.where(known[:, None, None, None], mats, sixd_to_matrix(sixd))
        x = self._seen(self._joined(root, sixd, mats, offsets))
        extra = None if code is None else self.code(code).unsqueeze(1)
        first = self._correct(self.encoder, x, root, sixd, mats, known, near, extra, drop)
        if self.refiner is None:
            return first, None
        held = GapFrames(*(v.detach() for v in first))
        sixd = held.mats[..., :2].transpose(-1, -2).flatten(-2)
        x = self._seen(self._joined(held.root, sixd, held.mats, offsets))
        x = torch.cat((x, held.contact), -1)
        return first, self._correct(
            self.refiner, x, held.root, sixd, held.mats, known, near, extra, drop
        )

    def _correct(
        self,
        encoder: _Encoder,
        x: Tensor,
        root: Tensor,
        sixd: Tensor,
        mats: Tensor,
        known: Tensor,
        near: Neighbours,
        extra: Tensor | None,
        drop: Dropout | None,
    ) -> GapFrames:
        out = encoder(x, known, near, extra, drop).float()
        joints = self.layout.joints
        free = (~known).to(out)[:, None]
        root = root + free * out[..., :3] * self.feature_std[:3]
        delta = out[..., 3 : 3 + 6 * joints].unflatten(-1, (joints, 6))
        turned = sixd_to_matrix(sixd + delta)
        mats = torch.where(known[:, None, None, None], mats, turned)
        return GapFrames(root, mats, out[..., 3 + 6 * joints :])

    def complete(
        self,
        root: Tensor,
        rot: Tensor,
        known: Tensor,
        offsets: Tensor,
        noise: torch.Generator | None = None,
    ) -> FilledGap:
        """All frames `(N, T, ...)`, in the world, with the unknown ones filled; see `forward`."""
        at = last_before_gap(known)
        place = place_of(root[:, at], rot[:, at], self.layout.facing)
        code = None if noise is None or not self.config.latent else self.draw(len(root), noise)
        first, refined = self(*into_place(root, rot, place), known, offsets, code)
        gap = refined or first
        own, turned = out_of_place(gap.root, matrix_to_quat(gap.mats), place)
        turned = continued(turned, rot[:, 0])
        pos = matrix_kinematics(self.layout.parents, offsets.unsqueeze(1), own, quat_to_matrix(turned))[
            0
        ]
        return FilledGap(own, turned, gap.contact.sigmoid(), pos)

    def fill(self, known: Known, length: int, noise: torch.Generator | None = None) -> FilledGap:
        """See `learn.transition.TransitionNet`."""
        past = known.past_root.shape[1]
        n, joints = len(known.target_root), self.layout.joints
        gap_root = known.target_root.new_zeros(n, length, 3)
        gap_rot = known.target_rot.unsqueeze(1).expand(n, length, joints, 4)
        root = torch.cat((known.past_root, gap_root, known.target_root.unsqueeze(1)), 1)
        rot = torch.cat((known.past_rot, gap_rot, known.target_rot.unsqueeze(1)), 1)
        seen = torch.ones(past + length + 1, dtype=torch.bool)
        seen[past : past + length] = False
        filled = self.complete(root, rot, seen, known.offsets, noise)
        return FilledGap(*(v[:, past : past + length] for v in filled))


def last_before_gap(known: Tensor) -> int:
    """The last known frame before the first unknown one that has any before it."""
    rows = [int(i) for i in known.nonzero()]
    for a, b in pairwise(rows):
        if b > a + 1:
            return a
    return rows[-1]


class _Encoder(nn.Module):
    """Pre-norm transformer layers over frames, with a bias per head and distance in time."""

    def __init__(self, features: int, outputs: int, layers: int, c: BetweenConfig, g: torch.Generator):
        super().__init__()
        self.reach, self.heads = c.reach, c.heads
        self.enter = linear(features + 1, c.width, g)
        self.time = nn.Sequential(linear(64, c.width, g), nn.GELU(), linear(c.width, c.width, g))
        self.bias = nn.Parameter(torch.zeros(c.heads, 2 * c.reach + 1))
        self.layers = nn.ModuleList([_Layer(c, layers, g) for _ in range(layers)])
        self.norm = nn.LayerNorm(c.width)
        self.leave = linear(c.width, outputs, g, 0.0)

    def forward(
        self, x: Tensor, known: Tensor, near: Neighbours, extra: Tensor | None, drop: Dropout | None
    ) -> Tensor:
        flag = known.to(x)[:, None].expand(*x.shape[:-1], 1)
        t = torch.arange(len(known), device=x.device)
        times = torch.cat((_waves(t - near.before, 16), _waves(near.after - t, 16)), -1).to(x)
        h = self.enter(torch.cat((x, flag), -1)) + self.time(times)
        if extra is not None:
            h = h + extra
        apart = (t[:, None] - t[None, :]).clamp(-self.reach, self.reach) + self.reach
        bias = self.bias[:, apart]
        for layer in self.layers:
            h = layer(h, bias, drop)
        return self.leave(self.norm(h))


class _Layer(nn.Module):
    def __init__(self, c: BetweenConfig, layers: int, g: torch.Generator):
        super().__init__()
        self.heads = c.heads
        self.norm1, self.norm2 = nn.LayerNorm(c.width), nn.LayerNorm(c.width)
        self.mix = linear(c.width, 3 * c.width, g)
        self.out = linear(c.width, c.width, g, 1 / math.sqrt(2 * layers))
        self.up = linear(c.width, c.feedforward, g)
        self.down = linear(c.feedforward, c.width, g, 1 / math.sqrt(2 * layers))

    def forward(self, h: Tensor, bias: Tensor, drop: Dropout | None) -> Tensor:
        n, t, width = h.shape
        q, k, v = self.mix(self.norm1(h)).view(n, t, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        a = functional.scaled_dot_product_attention(q, k, v, attn_mask=bias.to(q).unsqueeze(0))
        mixed = self.out(a.transpose(1, 2).reshape(n, t, width))
        h = h + (mixed if drop is None else mixed * drop.mask(mixed))
        more = self.down(functional.gelu(self.up(self.norm2(h))))
        return h + (more if drop is None else more * drop.mask(more))


def _waves(x: Tensor, count: int) -> Tensor:
    """Sines and cosines `(..., 2 count)` of frames, with periods from 3 to 300 frames."""
    rate = 2 * math.pi / torch.logspace(math.log10(3), math.log10(300), count)
    angle = x.unsqueeze(-1) * rate
    return torch.cat((angle.sin(), angle.cos()), -1)


def linear(a: int, b: int, generator: torch.Generator, scale: float = 1.0) -> nn.Linear:
    """A linear layer from a generator of its own: Xavier uniform times `scale`, no bias at first."""
    layer = cast(nn.Linear, nn.utils.skip_init(nn.Linear, a, b))
    bound = scale * math.sqrt(6 / (a + b))
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.zero_()
    return layer


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
    """Loss and update of a `Between` network; see `learn.inbetween_model.InbetweenTrainer`."""

    def __init__(self, net: Between, config: BetweenTraining, std: Tensor, steps: int):
        self.net, self.config, self.std, self.steps = net, config, std, steps
        decayed = [p for p in net.parameters() if p.ndim > 1]
        plain = [p for p in net.parameters() if p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": config.weight_decay},
                  {"params": plain, "weight_decay": 0.0}]  # fmt: skip
        self.optimizers: dict[str, Optimizer] = {"net": Adam(groups, lr=config.lr, betas=(0.9, 0.98))}
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
                own = self.parts(gap, truth, batch, known)
                total = total + sum(getattr(self.config, k) * v for k, v in own.items())
                parts |= {f"{name}{k}": v for k, v in own.items()}
        return total, {k: v.detach() for k, v in parts.items()}

    def parts(
        self, gap: GapFrames, truth: tuple[Tensor, Tensor], batch: Windows, known: Tensor
    ) -> dict[str, Tensor]:
        """The parts of the loss before their weights, scalars: of positions, turns and velocities in
        standard deviations, of contacts, and m a frame that feet slide where contact is said.

        Args:
            gap: what the network made. batch: the windows.
            truth: their joints' places `(N, L, J, 3)` m and turns `(N, L, J, 3, 3)` in the world.
            known: `(L,)` bool, frames that were given.
        """
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
