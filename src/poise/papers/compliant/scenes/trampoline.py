"""Standing on a trampoline that bounces (Deep Compliant Control, Sec. 5.3 and Fig. 5)."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.events import Happening, InScene, ScenePart, SetDown, touches_of
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.papers.compliant.scenes.stage import Given, Stage, as_given
from poise.sim import Plane, SceneSim
from poise.sim.props import Trampoline as Plate

#: s from bounce to bounce, and from a contact on for which the character gives way.
EVERY_S, GIVES_S = 3.0, 1.0
#: s: how long a bounce's actuators are up. N on the feet is contact.
UP_S, CONTACT_N = 0.12, 20.0
#: m, the floor below the plate.
BELOW_M = -1.0


@dataclass(frozen=True)
class Trampoline:
    """A rigid plate on four linear actuators, which throws the character up every 3 s.

    Contacts of the feet are given way to for 1 s after the feet have come down again.

    Attributes:
        height: m, by which the actuators rise for a bounce.
        first: s, when the first bounce begins.
    """

    height: float = 0.15
    first: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.height <= 1.0:
            raise PoiseError(f"a bounce is 0 to 1 m high, got {self.height:g}", "trampoline")
        if not 0.0 <= self.first < EVERY_S:
            what = f"the first bounce begins within {EVERY_S:g} s, got {self.first:g}"
            raise PoiseError(what, "trampoline")

    def stage(self, humanoid: Humanoid, reference: Reference) -> Stage:
        """The plate in place of the floor, its bounces, and the feet's contacts."""
        # In the middle of what the motion crosses.
        low, high = torch.aminmax(reference.pose.pos[:, 0, :2], dim=0)
        x, y = (0.5 * (low + high)).tolist()
        plate = Plate(pos=(x, y, 0.0))
        feet = tuple(humanoid.bodies[i] for i in humanoid.feet)
        touches = touches_of("felt", plate.name, feet)
        names = tuple(t.name for t in touches)
        bounce = Bounce(plate.name, self.height, names, self.first)
        part = InScene(
            sees=(plate.name,), felt=names, felt_part=dict.fromkeys(names, after_contact),
            events=(SetDown(plate.name, (0.0, 0.0, 0.0)), bounce),
        )  # fmt: skip
        return Stage((plate,), (), touches, (part,), from_start=True,
                     floor=Plane(BELOW_M), yields=stands_still)  # fmt: skip


def stands_still(given: Given | None) -> Given:
    """Gives way by the hinges alone: with the root the goal would slide away from under the feet."""
    return replace(as_given(given), root=False)


def after_contact(part: ScenePart, force: Tensor) -> Tensor:
    """A force where the character gives way just now, else 0."""
    bounce = next(h for h in part.happenings if isinstance(h, Bouncing))
    return force * (bounce.gives > 0).to(force).unsqueeze(1)


@dataclass(frozen=True)
class Bounce:
    """A plate's actuators rise for a moment, every 3 s.

    Attributes:
        plate: its name.
        height: m.
        touches: of the feet with it.
        first: s, when the first bounce begins.
    """

    plate: str
    height: float
    touches: tuple[str, ...]
    first: float = 1.0

    def __call__(self, sim: SceneSim, control_hz: float) -> Happening:
        """The event in the worlds of a scene."""
        return Bouncing(self, sim, control_hz)


class Bouncing(Happening):
    """`Bounce` in N worlds.

    Attributes:
        steps: `(N,)` control steps since the episode began.
        air: `(N,)` whether the feet have left the plate since the last bounce began.
        gives: `(N,)` control steps for which the character gives way yet.
        first_s: s, when the first bounce begins.
    """

    def __init__(self, event: Bounce, sim: SceneSim, control_hz: float):
        self.first_s = event.first
        self._event, self._sim, self._hz = event, sim, control_hz
        self._controls = sim.scene.place(event.plate).controls
        here = sim.backend.device
        self.steps = torch.zeros(sim.num_envs, dtype=torch.long, device=here)
        self.gives, self.air = torch.zeros_like(self.steps), torch.zeros_like(self.steps)

    def rows(self) -> dict[str, Tensor]:
        return {"steps": self.steps, "gives": self.gives, "air": self.air}

    def begin(self, worlds: Tensor) -> None:
        for value in (self.steps, self.gives, self.air):
            value[worlds] = 0

    def before(self) -> None:
        since = self.steps / self._hz - self._event.first
        up = (since >= 0.0) & (since.remainder(EVERY_S) < UP_S)
        drive = self._sim.backend.drive.ctrl
        drive[:, self._controls] = self._event.height * up.to(drive).unsqueeze(1)

    def after(self) -> None:
        self.steps += 1
        force = sum(self._sim.touch(name).force.norm(dim=-1) for name in self._event.touches)
        stands = torch.as_tensor(force) > CONTACT_N
        down = stands & (self.air > 0)
        self.gives = torch.where(down, round(GIVES_S * self._hz), (self.gives - 1).clamp_min(0))
        self.air = (~stands).long()
