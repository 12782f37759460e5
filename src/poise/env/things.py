"""Events of props and links: things set down, thrown, moved, and links that are switched."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from poise.env.events import Condition, Happening, RandomEvent
from poise.errors import PoiseError, did_you_mean
from poise.settings import Checked, Positive, Range
from poise.sim import SceneSim

G = 9.81


@dataclass(frozen=True)
class SetDown:
    """A thing that begins each episode where it is told, with other links and things as they are.

    Attributes:
        name: of the thing.
        qpos: its coordinates, such as place and wxyz quaternion of a free body; a door's angle.
        qvel: its velocities; none is rest.
        spread: by how much each velocity's coordinate is moved at random to either side, m or rad; one
            number for all or one for each degree of freedom that is not a rotation of a free body.
        seed: of the draws.
    """

    name: str
    qpos: tuple[float, ...]
    qvel: tuple[float, ...] = ()
    spread: float = 0.0
    seed: int = 0

    def __call__(self, sim: SceneSim, control_hz: float) -> Happening:
        """The event in the worlds of a scene."""
        return _SetDown(self, sim)


class _SetDown(RandomEvent):
    def __init__(self, event: SetDown, sim: SceneSim):
        super().__init__(event.seed)
        place = sim.scene.place(event.name)
        dofs = place.dofs.stop - place.dofs.start
        if len(event.qpos) != place.coordinates or len(event.qvel) not in (0, dofs):
            raise PoiseError(
                f"'{event.name}' has {place.coordinates} coordinates and {dofs} velocities, got "
                f"{len(event.qpos)} and {len(event.qvel)}",
                "SetDown",
                code="count-differs",
            )
        self._event, self._sim = event, sim
        self._qpos = torch.tensor(event.qpos, dtype=torch.float64)
        self._qvel = torch.tensor(event.qvel or (0.0,) * dofs, dtype=torch.float64)
        # A free body's quaternion is left as it is.
        self._moved = 3 if place.coordinates == 7 and dofs == 6 else place.coordinates

    def begin(self, worlds: Tensor) -> None:
        n, spread = len(worlds), self._event.spread
        qpos = self._qpos.repeat(n, 1)
        if spread:
            qpos[:, : self._moved] += self.between(-spread, spread, n, self._moved)
        here = self._sim.backend.device
        self._sim.place(self._event.name, qpos.to(here), self._qvel.repeat(n, 1).to(here), worlds)


@dataclass(frozen=True)
class Throw(Checked):
    """A free body that is thrown at another one from all around, again and again.

    It flies so that it would hit the body's centre if that kept its velocity.

    Attributes:
        name: of the free body.
        at: the body that it is thrown at, such as "anna/torso".
        speed: m/s along the ground, drawn between.
        distance: m, from where.
        every_s: s between throws, drawn between.
        height: m above the target from where, drawn between.
        seed: of the draws.
    """

    name: str
    at: str
    speed: Annotated[tuple[float, float], Range(0, above=True, rising=True, unit="m/s")] = (2.0, 3.0)
    distance: Positive = 1.5
    every_s: Annotated[tuple[float, float], Range(0, above=True, rising=True, unit="s")] = (2.0, 3.0)
    height: tuple[float, float] = (-0.2, 0.2)
    seed: int = 0

    def __call__(self, sim: SceneSim, control_hz: float) -> Happening:
        """The event in the worlds of a scene."""
        return _Throw(self, sim, control_hz)


class _Throw(RandomEvent):
    def __init__(self, event: Throw, sim: SceneSim, control_hz: float):
        super().__init__(event.seed)
        if sim.scene.place(event.name).coordinates != 7:
            raise PoiseError(
                f"'{event.name}' is not free to fly",
                "Throw",
                "Throw a Ball or a Box",
                code="not-free-to-fly",
            )
        names = [sim.scene.model.body(i).name for i in range(sim.scene.model.nbody)]
        if event.at not in names:
            hint = did_you_mean(event.at, names)
            raise PoiseError(
                f"there is no body '{event.at}' in the scene", "Throw", hint, code="unknown-body"
            )
        self._event, self._sim, self._hz = event, sim, control_hz
        self._body = names.index(event.at)
        self.left = torch.zeros(sim.num_envs, dtype=torch.long, device=sim.backend.device)
        self.thrown = torch.zeros_like(self.left)
        self.begin(torch.arange(sim.num_envs))

    def rows(self) -> dict[str, Tensor]:
        return {"left": self.left, "thrown": self.thrown}

    def begin(self, worlds: Tensor) -> None:
        wait = self.between(*self._event.every_s, len(worlds)) * self._hz
        self.left[worlds] = wait.round().long().clamp_min(1).to(self.left.device)
        self.thrown[worlds] = 0

    def before(self) -> None:
        self.left -= 1
        now = (self.left <= 0).nonzero().squeeze(-1)
        if not len(now):
            return
        event, state, n = self._event, self._sim.backend.state, len(now)
        angle, speed, up = (
            self.between(low, high, n).to(state.qpos)
            for low, high in ((0.0, 2.0 * torch.pi), event.speed, event.height)
        )
        target = state.xipos[now, self._body].to(state.qpos)
        arm = target - state.subtree_com[now, int(self._sim.scene.model.body_rootid[self._body])]
        spin, moves = state.cvel[now, self._body].split(3, -1)
        moves = moves + torch.linalg.cross(spin, arm)
        around = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), -1)
        start = target + event.distance * around
        start[:, 2] = (start[:, 2] + up).clamp_min(0.1)
        time = (event.distance / speed).unsqueeze(-1)
        velocity = (target - start) / time + moves
        velocity[:, 2:] += 0.5 * G * time
        turn = torch.zeros(n, 4).to(start)
        turn[:, 0] = 1.0
        qvel = torch.cat((velocity, torch.zeros_like(velocity)), -1)
        self._sim.place(event.name, torch.cat((start, turn), -1), qvel, now)
        seen = self.thrown[now] + 1
        self.begin(now)
        self.thrown[now] = seen


@dataclass(frozen=True)
class Switch:
    """A link that is switched on where a condition becomes true, and off where another one does.

    Attributes:
        link: its name.
        on: when, such as "the hand is near the knob"; see `near`.
        off: when it is let go; None: only when episodes begin.
    """

    link: str
    on: Condition
    off: Condition | None = None

    def __call__(self, sim: SceneSim, control_hz: float) -> Happening:
        """The event in the worlds of a scene."""
        return _Switch(self, sim)


class _Switch(Happening):
    def __init__(self, event: Switch, sim: SceneSim):
        names = [link.name for link in sim.scene.scene.links]
        if event.link not in names:
            hint = did_you_mean(event.link, names)
            raise PoiseError(f"there is no link '{event.link}'", "Switch", hint, code="unknown-link")
        self._event, self._sim, self._row = event, sim, names.index(event.link)

    def begin(self, worlds: Tensor) -> None:
        begins_on = self._sim.scene.scene.links[self._row].on
        self._sim.switch(self._event.link, begins_on, worlds)

    def before(self) -> None:
        active = self._sim.backend.state["eq_active"][:, self._row].bool()
        off = self._event.off
        if off is not None and len(rows := (active & off(self._sim)).nonzero().squeeze(-1)):
            self._sim.switch(self._event.link, False, rows)
        if len(rows := (~active & self._event.on(self._sim)).nonzero().squeeze(-1)):
            self._sim.switch(self._event.link, True, rows)


def near(a: str, b: str, metres: float) -> Condition:
    """Whether the centres of two bodies are as near as that."""

    def condition(sim: SceneSim) -> Tensor:
        first, second = (sim.scene.model.body(name).id for name in (a, b))
        pos = sim.backend.state.xipos
        return (pos[:, first] - pos[:, second]).norm(dim=-1) <= metres

    return condition


def always(sim: SceneSim) -> Tensor:
    """In all worlds."""
    return torch.ones(sim.num_envs, dtype=torch.bool, device=sim.backend.device)


@dataclass(frozen=True)
class Move:
    """A thing that goes a way of its own: it is set to it at every control step, velocity and all.

    Attributes:
        name: of the thing, such as a `Carrier`.
        path: of the seconds since the episode began `(N,)`, coordinates `(N, q)` and velocities
            `(N, v)`.
    """

    name: str
    path: Callable[[Tensor], tuple[Tensor, Tensor]]

    def __call__(self, sim: SceneSim, control_hz: float) -> Happening:
        """The event in the worlds of a scene."""
        return _Move(self, sim, control_hz)


class _Move(Happening):
    def __init__(self, event: Move, sim: SceneSim, control_hz: float):
        self._event, self._sim, self._hz = event, sim, control_hz
        self._place = sim.scene.place(event.name)
        self.steps = torch.zeros(sim.num_envs, dtype=torch.long, device=sim.backend.device)
        self.before()

    def rows(self) -> dict[str, Tensor]:
        return {"steps": self.steps}

    def begin(self, worlds: Tensor) -> None:
        self.steps[worlds] = 0
        qpos, qvel = self._event.path(self.steps / self._hz)
        self._sim.place(self._event.name, qpos[worlds], qvel[worlds], worlds)

    def before(self) -> None:
        # What follows from the state is computed by the step that comes.
        state, (qpos, qvel) = self._sim.backend.state, self._event.path(self.steps / self._hz)
        state.qpos[:, self._place.qpos] = qpos.to(state.qpos)
        state.qvel[:, self._place.dofs] = qvel.to(state.qvel)

    def after(self) -> None:
        self.steps += 1
