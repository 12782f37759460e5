"""Hand in hand with a partner that moves kinematically (Deep Compliant Control, Sec. 5.3)."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.events import InScene, Move, Switch, always
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.papers.compliant.scenes.stage import Stage, hand_of
from poise.sim import Link
from poise.sim.props import Carrier


@dataclass(frozen=True)
class Hands:
    """A partner's hand on a straight way beside the character, joined to its hand by a ball joint.

    The partner is not simulated: its hand goes as fast as the motion goes on average, and `lead` faster,
    and swings by `sway` along the way and up and down.

    Attributes:
        side: of the character's hand.
        lead: m/s.
        sway: m, to either side.
        every_s: s, the time of a swing.
    """

    side: Literal["left", "right"] = "left"
    lead: float = 0.0
    sway: float = 0.1
    every_s: float = 2.0

    def __post_init__(self) -> None:
        if not (abs(self.lead) < 10.0 and 0.0 <= self.sway < 1.0 and self.every_s > 0.1):
            raise PoiseError(
                "the partner's lead must be below 10 m/s, its sway below 1 m, a swing longer than 0.1 s",
                "hands",
            )

    def stage(self, humanoid: Humanoid, reference: Reference) -> Stage:
        """The partner's hand where the character's is at first, and the link; its force is felt."""
        row = hand_of(humanoid, self.side, "hands")
        frames, pose = int(reference.length[0]), reference.pose
        x, y, z = (float(v) for v in pose.pos[0, row])
        way = (pose.pos[frames - 1, 0, :2] - pose.pos[0, 0, :2]).double()
        speed = way * reference.rate_hz / max(1, frames - 1)
        size = float(speed.norm())
        # A motion that stays is led where its left is, or where it goes.
        ahead = speed / size if size > 0.1 else torch.tensor([0.0, 1.0]).double()
        velocity = speed + self.lead * ahead
        name, body = "partner", humanoid.bodies[row]
        prop = Carrier(name, (0.09, 0.09, 0.09), (x, y, z), touched=False)
        part = InScene(
            sees=(name,),
            felt=("hands",),
            events=(Move(name, self._path(velocity, ahead)), Switch("hands", always)),
        )
        return Stage((prop,), (Link("hands", name, body, "ball", measured=True),), (), (part,))

    def _path(self, velocity: Tensor, ahead: Tensor) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
        w = 2.0 * math.pi / self.every_s

        def path(seconds: Tensor) -> tuple[Tensor, Tensor]:
            t = seconds.double().unsqueeze(1)
            swing, rate = self.sway * torch.sin(w * t), self.sway * w * torch.cos(w * t)
            still = torch.zeros_like(t)
            qpos = torch.cat((velocity * t + ahead * swing, 0.5 * swing, still), 1)
            qvel = torch.cat((velocity + ahead * rate, 0.5 * rate, still), 1)
            return qpos, qvel

        return path
