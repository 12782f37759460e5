"""The recurrent transition network of Harvey et al., "Robust Motion In-betweening", 2020.

Three encoders (state, offset to the target, target), a time-to-arrival embedding, scheduled target
noise, one LSTM, a decoder of velocities, and two critics. Frame after frame it says what changes:

    h = LSTM([E_s(q, v, c); E_o(r_T - r, q_T - q); E_q(q_T)] + z_tta),  (dq, dr, c) = D(h)

Where the paper is silent, values are those of its public re-implementations (see the config).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.nets.between import linear
from poise.nets.transition import (
    Filled,
    Known,
    Layout,
    continued,
    into_place,
    joint_positions,
    out_of_place,
    place_of,
)
from poise.spatial import normalize

#: Squared step in m^2 under which a foot joint of the past counts as in contact (0.02 cm^2).
_CONTACT = 2e-6


@dataclass(frozen=True)
class RTNConfig:
    """Sizes of the recurrent network."""

    hidden: int = 512
    """Width of the LSTM; no source states it, public codes have 512 and 768."""
    encoder: tuple[int, int] = (512, 256)
    decoder: tuple[int, int] = (512, 256)
    past: int = 10
    longest: int = 30
    """P_max, the longest transition trained; times to arrival are clamped at past + P_max - 5."""
    noise: float = 0.5
    """Deviation of the target noise."""

    def __post_init__(self) -> None:
        if min(self.hidden, *self.encoder, *self.decoder, self.past, self.longest) < 1:
            raise PoiseError("every size must be at least 1", "RTNConfig")

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


class Steps(NamedTuple):
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
    """The generator; see the module's text.

    Args:
        layout: the skeleton.
        generator: source of the first weights.
    """

    velocity_std: Tensor
    offset_std: Tensor
    usual_rot: Tensor

    def __init__(self, layout: Layout, config: RTNConfig | None = None, *, generator: torch.Generator):
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
            linear(c.hidden, a, generator), PLU(), linear(a, b, generator), PLU(),
            linear(b, quats + 3 + feet, generator, 0.01),
        )  # fmt: skip
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

    def forward(self, known: Known, length: int, noise: Tensor | None = None) -> Steps:
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
        return Steps(roots, rots.unflatten(-1, (-1, 4)), contacts)

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

    def fill(self, known: Known, length: int, noise: torch.Generator | None = None) -> Filled:
        """See `nets.transition.TransitionNet`; `noise` draws the target noise for variety."""
        place = place_of(known.past_root[:, -1], known.past_rot[:, -1], self.layout.facing)
        draw = None if noise is None else self.draw(len(known.target_root), noise)
        steps = self(self.seen(known), length, draw)
        root, rot = out_of_place(steps.root, steps.rot, place)
        rot = continued(rot, known.past_rot[:, -1])
        return Filled(root, rot, steps.contact, joint_positions(self.layout, known.offsets, root, rot))


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
            linear(channels * window, 512, generator), nn.ReLU(),
            linear(512, 256, generator), nn.ReLU(), linear(256, 1, generator),
        )  # fmt: skip

    def forward(self, frames: Tensor) -> Tensor:
        """`(N, T, channels)` to one number per sequence `(N)`."""
        # A convolution over time with the window as its kernel.
        windows = frames.unfold(1, self.window, 1).flatten(2)
        return self.layers(windows).squeeze(-1).mean(1)


def _encoder(inputs: int, sizes: tuple[int, int], generator: torch.Generator) -> nn.Sequential:
    a, b = sizes
    return nn.Sequential(linear(inputs, a, generator), PLU(), linear(a, b, generator), PLU())
