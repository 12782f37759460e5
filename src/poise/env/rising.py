"""From lying to standing: by which poses, and how these follow one another."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from poise.body import BodyTable
from poise.env.ways import LIES, Ways
from poise.kin import Kinematics, lowest_height
from poise.spatial import quat_conj, quat_distance, quat_mul, quat_rotate, slerp
from poise.spatial.turns import turned, yaw_quat

#: s that a blend takes, and m of the distance between poses that are blended in a second more.
BLEND_S, BLEND_SPEED = 0.4, 1.0
#: m: no limb that would reach into the floor lifts who is blended higher.
LIFT = 0.12
#: s of rolling over, m that who rolls moves for each rad, m^2 that it counts where ways are compared.
ROLL_S, ROLLS, TOPPLES = 1.2, 0.15, 0.16
#: m that a rad of the bodies' rotations counts, where poses are compared.
TURNED = 0.3


class Rising:
    """How the characters of a library get up from anywhere.

    A clip that gets up is entered at the frame that is nearest to how somebody lies. Where none is near,
    as for who lies prone and knows only how to get up from the back, it goes up to a low pose of the
    library, such as on hands and knees, topples over to a side from there, which takes little more
    than gravity, and rolls on to where the clip is near.
    """

    def __init__(self, ways: Ways, table: BodyTable, rate_hz: float):
        self.ways, self.table, self.rate_hz = ways, table, rate_hz
        self._ups = [Poses(table, clip) for clip in ways.ups]
        self._lows = Poses(table, ways.lows) if len(ways.lows) else None
        # A clip is entered while it lies: what comes later needs what came before.
        for up in self._ups:
            up.keep(up.pos[..., 2].amax(-1) < LIES * float(ways.ease[2]))
        over = self._on_floor(self._rolled(ways.lows, math.pi))
        self._over = [Poses(table, over).apart(up) ** 2 if len(over) else None for up in self._ups]

    def up(self, start: Tensor, which: int = 0, side: float = 1.0) -> Tensor:
        """`(T, 7 + n)` from lying at `start (7 + n)` to the end of the clip `which` that gets up.

        side: 1 or -1, over which side is rolled, where that is needed.
        """
        which %= len(self.ways.ups)
        clip, over = self.ways.ups[which], self._over[which]
        lying = Poses(self.table, start[None])
        direct, parts = lying.apart(self._ups[which])[0] ** 2, []
        entry, at = int(direct.argmin()), start
        if self._lows is not None and over is not None:
            through = lying.apart(self._lows)[0, :, None] ** 2 + TOPPLES + over
            if float(through.min()) < float(direct.min()):
                via, entry = divmod(int(through.argmin()), through.shape[1])
                low = self._laid(start, self.ways.lows[via : via + 1])[0]
                roll = self._roll(low, side)
                parts, at = [self._blend(start, low)[:-1], roll[:-1]], roll[-1]
        clip = self._laid(at, clip[int(self._ups[which].rows[entry]) :])
        frames = torch.cat((*parts, self._blend(at, clip[0])))
        return torch.cat((self._on_floor(frames, LIFT)[:-1], clip))

    def _roll(self, low: Tensor, side: float) -> Tensor:
        """From a low pose over a side until what was up is down."""
        count = round(self.rate_hz * ROLL_S)
        angle = side * math.pi * smooth(torch.linspace(0, 1, count + 1, dtype=torch.float64))
        frames = low.expand(count + 1, -1).clone()
        frames = self._rolled(frames, angle)
        axis = quat_rotate(low[3:7], self._along)
        # It rolls to where what is up goes: w x Z.
        frames[:, 0] += ROLLS * angle * axis[1]
        frames[:, 1] -= ROLLS * angle * axis[0]
        return self._on_floor(frames)

    @property
    def _along(self) -> Tensor:
        """The body's long axis, as the root has it: what is up in who stands."""
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        return quat_rotate(quat_conj(self.ways.ease[3:7]), up)

    def _rolled(self, qpos: Tensor, angle: Tensor | float) -> Tensor:
        """Frames turned about their long axes by `angle` rad."""
        half = 0.5 * torch.as_tensor(angle, dtype=torch.float64).expand(len(qpos)).unsqueeze(-1)
        turn = torch.cat((half.cos(), half.sin() * self._along), -1)
        out = qpos.clone()
        out[:, 3:7] = quat_mul(qpos[:, 3:7], turn)
        return out

    def _on_floor(self, frames: Tensor, most: float = math.inf) -> Tensor:
        """Frames raised or lowered until they touch the floor, by no more than `most` m up."""
        body, out = Kinematics(self.table)(frames), frames.clone()
        if len(frames):
            lift = -lowest_height(self.table, body.pos, body.quat).amin(-1)
            out[:, 2] += lift.clamp(max=most)
        return out

    def _laid(self, onto: Tensor, frames: Tensor) -> Tensor:
        """Frames moved and turned so that the first lies on the pose `onto`."""
        own, there = (Poses(self.table, q[None]) for q in (frames[0], onto))
        return turned(frames, float(there.turn(own)), own.centre[0], there.centre[0])

    def _blend(self, a: Tensor, b: Tensor) -> Tensor:
        gap = float(Poses(self.table, a[None]).apart(Poses(self.table, b[None])))
        return blend(a, b, round(self.rate_hz * (BLEND_S + gap / BLEND_SPEED)))


class Poses:
    """Poses that are compared, wherever they stand and whichever way they face.

    Args:
        qpos: `(P, 7 + n)` of a body `table`.
    """

    def __init__(self, table: BodyTable, qpos: Tensor):
        body = Kinematics(table)(qpos)
        self.quat, self.centre = body.quat, body.pos[..., :2].mean(1)
        self.pos, self.rows = body.pos.clone(), torch.arange(len(qpos))
        self.pos[..., :2] -= self.centre.unsqueeze(1)

    def keep(self, those: Tensor) -> None:
        """Only some rows, `(P,)` bool; `rows` says which of all they are."""
        for name in ("pos", "quat", "centre", "rows"):
            setattr(self, name, getattr(self, name)[those])

    def turn(self, other: Poses) -> Tensor:
        """`(P, Q)` rad about Z that lay each pose of `other` best on each of these."""
        p, q = self.pos[:, None, :, :2], other.pos[None, :, :, :2]
        cross = (q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]).sum(-1)
        return torch.atan2(cross, (p * q).sum((-1, -2)))

    def apart(self, other: Poses) -> Tensor:
        """`(P, Q)` m: how far bodies are apart and, `TURNED` m for a rad, how they are turned."""
        turn = self.turn(other)
        out = torch.empty_like(turn)
        # Row by row, since all pairs of all bodies are many.
        for i, angles in enumerate(turn):
            yaw = yaw_quat(angles).unsqueeze(1).expand_as(other.quat)
            far = (quat_rotate(yaw, other.pos) - self.pos[i]).norm(dim=-1)
            faces = quat_distance(quat_mul(yaw, other.quat), self.quat[i].expand_as(yaw))
            out[i] = (far + TURNED * faces).mean(-1)
        return out


def blend(a: Tensor, b: Tensor, frames: int) -> Tensor:
    """`(frames + 1, 7 + n)` from one pose to another."""
    share = smooth(torch.linspace(0, 1, frames + 1, dtype=torch.float64))
    return mixed(a.expand(frames + 1, -1), b.expand(frames + 1, -1), share)


def mixed(a: Tensor, b: Tensor, share: Tensor) -> Tensor:
    out = torch.lerp(a, b, share.unsqueeze(-1))
    out[:, 3:7] = slerp(a[:, 3:7], b[:, 3:7], share)
    return out


def smooth(share: Tensor) -> Tensor:
    return share * share * (3 - 2 * share)
