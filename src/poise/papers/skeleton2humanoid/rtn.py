"""The recurrent transition network (Harvey et al. 2020), generator and critics, and one step of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from poise.learn.adam import Adam, Optimizer
from poise.learn.between import linear, schedule
from poise.learn.networks import bfloat16_is_fast
from poise.learn.transition import (
    FilledGap,
    Known,
    SkeletonLayout,
    continued,
    into_place,
    joint_positions,
    out_of_place,
    place_of,
)
from poise.learn.window_sampler import Sampler, Windows
from poise.motion.rotations import normalize
from poise.settings import Checked, Count, Range

#: Squared step in m^2 under which a foot joint of the past counts as in contact (0.02 cm^2).
_CONTACT = 2e-6


@dataclass(frozen=True)
class RTNConfig(Checked):
    """Sizes of the recurrent network."""

    hidden: Count = 512
    """Width of the LSTM; no source states it, public codes have 512 and 768."""
    encoder: Annotated[tuple[int, int], Range(1)] = (512, 256)
    decoder: Annotated[tuple[int, int], Range(1)] = (512, 256)
    past: Count = 10
    longest: Count = 30
    """P_max, the longest transition trained; times to arrival are clamped at past + P_max - 5."""
    noise: float = 0.5
    """Deviation of the target noise."""

    @property
    def latest(self) -> int:
        """T_max, the largest time to arrival that is told apart."""
        return self.past + self.longest - 5


class PLU(nn.Module):
    """Parametric linear unit, PLU(x) = max(a (x + c) - c, min(a (x - c) + c, x)), a = 0.1, c = 1."""

    def forward(self, x: Tensor) -> Tensor:
        """The same shape as `x`."""
        # Between -c and c it is x, outside it goes on with slope a.
        return 0.1 * x + 0.9 * x.clamp(-1.0, 1.0)


def arrival_embedding(tta: Tensor, width: int) -> Tensor:
    """z_2i = sin(tta / 10000^(2i/d)), z_2i+1 = cos(same): `(...)` frames to `(..., d)`."""
    power = torch.arange(0, width, 2, device=tta.device) / width
    angle = tta.unsqueeze(-1) / 10000**power
    return torch.stack((angle.sin(), angle.cos()), -1).flatten(-2)


def noise_scale(tta: Tensor) -> Tensor:
    """lambda of the target noise: 1 from 30 frames on, (tta - 5) / 25 from 5, 0 under 5."""
    return ((tta - 5) / 25).clamp(0.0, 1.0)


class RtnOutput(NamedTuple):
    """What the network said, in the place of the last frame seen.

    Attributes:
        root: `(N, L, 3)` m.
        rot: `(N, L, J, 4)` wxyz, unit.
        contact: `(N, L, F)`.
    """

    root: Tensor
    rot: Tensor
    contact: Tensor


class RTN(nn.Module):
    """The generator, "Robust Motion In-betweening" (Harvey et al. 2020), section 3.

    Three encoders (state, offset to the target, target), a time-to-arrival embedding z_tta, scheduled
    target noise, one LSTM and a decoder say frame after frame what changes:

        h = LSTM([E_s(q, v, c); E_o(r_T - r, q_T - q); E_q(q_T)] + z_tta),  (dq, dr, c) = D(h)

    Where the paper is silent, values are those of its public re-implementations, see `RTNConfig`.

    Args:
        layout: the skeleton.
        generator: source of the first weights.
    """

    velocity_std: Tensor
    offset_std: Tensor
    usual_rot: Tensor

    def __init__(
        self, layout: SkeletonLayout, config: RTNConfig | None = None, *, generator: torch.Generator
    ):
        super().__init__()
        self.layout, self.config = layout, config or RTNConfig()
        c, quats, feet = self.config, 4 * layout.joints, len(layout.feet)
        self.state = _encoder(quats + 3 + feet, c.encoder, generator)
        self.offset = _encoder(quats + 3, c.encoder, generator)
        self.target = _encoder(quats, c.encoder, generator)
        self.cell = cast(nn.LSTMCell, nn.utils.skip_init(nn.LSTMCell, 3 * c.encoder[1], c.hidden))
        with torch.no_grad():
            for p in self.cell.parameters():
                p.uniform_(-(c.hidden**-0.5), c.hidden**-0.5, generator=generator)
        a, b = c.decoder
        self.decoder = nn.Sequential(
            linear(c.hidden, a, generator),
            PLU(),
            linear(a, b, generator),
            PLU(),
            linear(b, quats + 3 + feet, generator, 0.01),
        )
        # Roots enter and leave in units of how much they vary (the paper uses raw centimetres).
        self.register_buffer("velocity_std", torch.full((3,), 0.02))
        self.register_buffer("offset_std", torch.full((3,), 0.5))
        # q and -q are one rotation, but not one input: signs are those nearest to the usual rotation.
        self.register_buffer("usual_rot", torch.tensor([1.0, 0, 0, 0]).repeat(layout.joints, 1))

    @torch.no_grad()
    def calibrate(self, root: Tensor, rot: Tensor, offsets: Tensor) -> None:
        """Takes the scale of root velocities and offsets, and usual rotations, from windows."""
        place = place_of(root[:, 0], rot[:, 0], self.layout.facing)
        root, rot = into_place(root, rot, place)
        flat = rot.flatten(0, 1)
        # The mean of rotations: the main axis of sum q q^T, which is blind to signs.
        self.usual_rot.copy_(torch.linalg.eigh(torch.einsum("nja,njb->jab", flat, flat))[1][..., -1])
        self.velocity_std.copy_(torch.diff(root, dim=1).flatten(0, 1).std(0).clamp_min(1e-3))
        self.offset_std.copy_((root - root[:, :1]).flatten(0, 1).std(0).clamp_min(1e-2))

    def forward(self, known: Known, length: int, noise: Tensor | None = None) -> RtnOutput:
        """The transition in the place of the last frame seen, in which `known` stands already.

        noise: `(N, 512)` standard normal, drawn once per sequence; None leaves the target as it is.
        """
        past, wide = known.past_root.shape[1], self.config.encoder[1]
        velocity = torch.diff(known.past_root, dim=1)
        velocity = torch.cat((velocity[:, :1], velocity), 1) if past > 1 else 0 * known.past_root
        contact = self._past_contacts(known)
        goal_root, goal = known.target_root, known.target_rot.flatten(1)
        target = self.target(goal)
        tta = torch.arange(past + length, 1, -1).to(goal)
        arrivals = arrival_embedding(tta.clamp(max=self.config.latest), wide)
        scales = self.config.noise * noise_scale(tta)
        root, rot = known.past_root[:, 0], known.past_rot[:, 0].flatten(1)
        speed, feet = velocity[:, 0], contact[:, 0]
        memory, out = None, []
        for i in range(past - 1 + length):
            if i < past:
                # The frames that were seen warm the LSTM up, whatever it said about them.
                root, rot = known.past_root[:, i], known.past_rot[:, i].flatten(1)
                speed, feet = velocity[:, i], contact[:, i]
            z = arrivals[i]
            s = self.state(torch.cat((rot, speed / self.velocity_std, feet), -1)) + z
            o = self.offset(torch.cat(((goal_root - root) / self.offset_std, goal - rot), -1)) + z
            aim = torch.cat((o, target + z), -1)
            if noise is not None:
                aim = aim + scales[i] * noise
            memory = self.cell(torch.cat((s, aim), -1), memory)
            if i < past - 1:
                continue
            # Under autocast the state goes on in float32.
            said = self.decoder(memory[0]).float()
            quats = rot.shape[1]
            rot = normalize((rot + said[:, :quats]).unflatten(-1, (-1, 4))).flatten(1)
            speed = said[:, quats : quats + 3] * self.velocity_std
            root, feet = root + speed, said[:, quats + 3 :].sigmoid()
            out.append((root, rot, feet))
        roots, rots, contacts = (torch.stack(x, 1) for x in zip(*out, strict=True))
        return RtnOutput(roots, rots.unflatten(-1, (-1, 4)), contacts)

    def _past_contacts(self, known: Known) -> Tensor:
        """Contacts of the past from its own steps: no later frame may be looked at."""
        feet = list(self.layout.feet)
        pos = joint_positions(self.layout, known.offsets, known.past_root, known.past_rot)[:, :, feet]
        if pos.shape[1] < 2:
            return pos.new_zeros(pos.shape[:-1])
        label = (torch.diff(pos, dim=1).square().sum(-1) < _CONTACT).to(pos)
        return torch.cat((label, label[:, -1:]), 1)

    def seen(self, known: Known) -> Known:
        """The same as seen from the last known frame, where `forward` wants it."""
        place = place_of(known.past_root[:, -1], known.past_rot[:, -1], self.layout.facing)
        root, rot = into_place(known.past_root, known.past_rot, place)
        goal = into_place(known.target_root.unsqueeze(1), known.target_rot.unsqueeze(1), place)
        rot = rot * self.signs(rot[:, -1]).unsqueeze(1)
        return Known(root, rot, goal[0][:, 0], continued(goal[1], rot[:, -1])[:, 0], known.offsets)

    def signs(self, rot: Tensor) -> Tensor:
        """1 or -1 `(N, J, 1)`, with which rotations `(N, J, 4)` are nearest to the usual ones."""
        dots = (rot * self.usual_rot).sum(-1, keepdim=True)
        return torch.where(dots < 0, -torch.ones_like(dots), torch.ones_like(dots))

    def draw(self, count: int, noise: torch.Generator) -> Tensor:
        """Target noise `(count, 512)` of standard normals."""
        return torch.randn(count, 2 * self.config.encoder[1], generator=noise).to(self.velocity_std)

    def fill(self, known: Known, length: int, noise: torch.Generator | None = None) -> FilledGap:
        """See `learn.transition.TransitionNet`; `noise` draws the target noise for variety."""
        place = place_of(known.past_root[:, -1], known.past_rot[:, -1], self.layout.facing)
        draw = None if noise is None else self.draw(len(known.target_root), noise)
        steps = self(self.seen(known), length, draw)
        root, rot = out_of_place(steps.root, steps.rot, place)
        rot = continued(rot, known.past_rot[:, -1])
        return FilledGap(
            root, rot, steps.contact, joint_positions(self.layout, known.offsets, root, rot)
        )


class Critic(nn.Module):
    """A sliding critic: a window of frames at a time, the mean over windows (LSGAN).

    Args:
        channels: of one frame.
        window: 2 frames for the short, 10 for the long one.
    """

    def __init__(self, channels: int, window: int, *, generator: torch.Generator):
        super().__init__()
        self.window = window
        self.layers = nn.Sequential(
            linear(channels * window, 512, generator),
            nn.ReLU(),
            linear(512, 256, generator),
            nn.ReLU(),
            linear(256, 1, generator),
        )

    def forward(self, frames: Tensor) -> Tensor:
        """`(N, T, channels)` to one number per sequence `(N)`."""
        # A convolution over time with the window as its kernel.
        windows = frames.unfold(1, self.window, 1).flatten(2)
        return self.layers(windows).squeeze(-1).mean(1)


def _encoder(inputs: int, sizes: tuple[int, int], generator: torch.Generator) -> nn.Sequential:
    a, b = sizes
    return nn.Sequential(linear(inputs, a, generator), PLU(), linear(a, b, generator), PLU())


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
    """Loss and update of an `RTN` and its two critics; see `learn.inbetween_model.InbetweenTrainer`."""

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
        self.optimizers: dict[str, Optimizer] = {
            name: Adam(of.parameters(), config.lr, (0.5, 0.9), amsgrad=True)
            for name, of in (("net", net), ("critics", self.critics))
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
        self, steps: RtnOutput, pos: Tensor, batch: Windows, truth: Tensor, fake: Tensor
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
