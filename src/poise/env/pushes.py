"""Pushes, at a stated time or several at random times, and things that are held."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor

from poise.env.events import EpisodeStart, Event, Felt, Force, StatedEvent
from poise.env.goal import Goal
from poise.errors import PoiseError
from poise.motion.rotations import quat_rotate
from poise.settings import Checked, Count, Length, Positive, Range, Share
from poise.sim import Backend, Drive


@dataclass
class Push(StatedEvent[Goal, Backend], Force, Checked):
    """A constant force on one body for some time of each episode; given to `TaskConfig.events`.

    At work it counts `step` `(N,)`, the control steps of each episode that were made, and keeps `acts`
    `(N,)` bool, the characters that are pushed in the next one.

    Attributes:
        row: of the body table; the force acts at the body's inertial centre.
        force: N, world axes.
        first: the control step of the episode in which it begins.
        steps: control steps that it lasts.
        foreseen: whether it begins and ends in this environment by itself. Copies in which a controller
            looks ahead take False: they feel what acts where they were copied, as long as they last,
            and know of no push to come.
        name: of its own, where a task has several.
    """

    row: Annotated[int, Range(0)]
    force: tuple[float, float, float]
    first: Annotated[int, Range(0)]
    steps: Count
    foreseen: bool = True
    name: str = "one push"

    def enter(self, goal: Goal, backend: Backend) -> None:
        bodies = len(goal.humanoid.bodies)
        if self.row >= bodies:
            raise PoiseError(
                f"the body has {bodies} parts, there is no row {self.row}", "Push", code="index-outside"
            )
        self._backend = backend
        n, here = backend.num_envs, backend.device
        self.step = torch.zeros(n, dtype=torch.long, device=here)
        self.acts = torch.zeros(n, dtype=torch.bool, device=here)
        self._newtons = torch.tensor(self.force).to(backend.drive.xfrc_applied)
        self._know()

    def begin(self, episodes: EpisodeStart) -> None:
        """Episodes begin before the push."""
        self.step[episodes.rows] = 0
        self._know()

    def before_step(self, drive: Drive) -> bool:
        """Adds the force."""
        drive.xfrc_applied[self.acts, self.row + 1, :3] += self._newtons
        return False

    def felt(self) -> Felt:
        """The push, where it acts."""
        n, body = len(self.acts), self.row + 1
        rows = torch.full((n, 1), body, dtype=torch.long, device=self.acts.device)
        force = self._newtons * self.acts.unsqueeze(1)
        return Felt(rows, self._backend.state.xipos[:, body : body + 1], force.unsqueeze(1))

    def after_step(self) -> None:
        """Counts on."""
        self.step += 1
        self._know()

    def rows(self) -> dict[str, Tensor]:
        return {f"{self.name}/step": self.step, f"{self.name}/acts": self.acts}

    def _know(self) -> None:
        if self.foreseen:
            self.acts.copy_((self.step >= self.first) & (self.step < self.first + self.steps))


@dataclass
class HeldThing(StatedEvent[Goal, Backend], Event, Checked):
    """A thing that a body holds for some time of each episode: a cube fixed to it with its middle at the
    body's inertial centre, which touches nothing; given to `TaskConfig.events`.

    Its mass and its inertia are the body's own while it is held, so that it weighs and resists as a
    solid does; m / 6 s^2 about each axis for an edge s.

    At work it counts `step` `(N,)`, the control steps of each episode that were made, and keeps `held`
    `(N,)` bool, the characters that hold it in the next one.

    Attributes:
        row: of the body table.
        mass: kg.
        size: m, the cube's edge.
        first: the control step of the episode in which it is taken.
        steps: control steps for which it is held.
        name: of its own, where a task has several; a body holds one at a time.
    """

    row: Annotated[int, Range(0)]
    mass: Positive
    size: Positive
    first: Annotated[int, Range(0)]
    steps: Count
    name: str = "held thing"

    def enter(self, goal: Goal, backend: Backend) -> None:
        bodies = len(goal.humanoid.bodies)
        if self.row >= bodies:
            raise PoiseError(
                f"the body has {bodies} parts, there is no row {self.row}",
                "HeldThing",
                code="index-outside",
            )
        self._backend = backend
        n, here = backend.num_envs, backend.device
        self.step = torch.zeros(n, dtype=torch.long, device=here)
        self.held = torch.zeros(n, dtype=torch.bool, device=here)
        self._weighs = torch.zeros(n, dtype=torch.bool, device=here)
        self._mass, self._inertia = backend.expand("body_mass"), backend.expand("body_inertia")
        self._own = self._mass[:, self.row + 1].clone(), self._inertia[:, self.row + 1].clone()
        self._know()
        self._weigh()

    def begin(self, episodes: EpisodeStart) -> None:
        """Episodes begin before it is taken, unless it is from their first step on."""
        self.step[episodes.rows] = 0
        self._know()

    def look(self, ids: Tensor | None) -> None:
        """Worlds have been set down, or are what a snapshot holds: their hands carry what they held."""
        self._know()
        self._weigh()

    def before_step(self, drive: Drive) -> bool:
        """Puts it into the hand, or takes it out."""
        self._weigh()
        return False

    def after_step(self) -> None:
        """Counts on."""
        self.step += 1
        self._know()

    def rows(self) -> dict[str, Tensor]:
        return {f"{self.name}/step": self.step}

    def _know(self) -> None:
        self.held.copy_((self.step >= self.first) & (self.step < self.first + self.steps))

    def _weigh(self) -> None:
        """Gives the bodies the mass that they have with it or without."""
        changed = (self.held != self._weighs).nonzero().squeeze(-1)
        if not len(changed):
            return
        self._weighs.copy_(self.held)
        share = self.held[changed].to(self._mass)
        body, (mass, inertia) = self.row + 1, self._own
        self._mass[changed, body] = mass[changed] + share * self.mass
        cube = self.mass * self.size**2 / 6.0
        self._inertia[changed, body] = inertia[changed] + (share * cube).unsqueeze(1)
        self._backend.set_const(changed)


#: Control steps until a push of an episode that has none.
NEVER = 10**9


@dataclass
class Pushes(StatedEvent[Goal, Backend], Force, Checked):
    """Pushes on random bodies at random times, each of a random horizontal direction; given to
    `TaskConfig.events`.

    At work it has, of N characters, `left` `(N,)`, control steps until a push begins, and from 0 down
    those that it has lasted; and of the next or present push `lasts` `(N,)` control steps, `force`
    `(N, 3)` N in world axes, and `body` `(N,)`, MuJoCo's body that it is on.

    Attributes:
        newtons: between which the force is drawn, N.
        every_s: between which the time from one push's end to the next one's begin is drawn, s; infinity
            for none after the first one.
        lasts_s: how long each lasts, s; two: between which that is drawn, evenly in its logarithm.
        share: of the episodes that have pushes.
        impulse_ns: N s that none has more of; long pushes are as much weaker.
        bodies: rows of the body table of which one is pushed at its inertial centre.
        control_hz: control steps per second.
        seed: of the draws.
        first_s: s of the episode in which the first one begins; None draws it as the later ones.
        direction: where they push to, in world axes, of any length; "front" pushes each character
            against where it faces when the push begins, "any" to a horizontal direction that is drawn.
        foreseen: whether pushes begin in this environment by themselves, see `Push.foreseen`.
        name: of its rows, where a task has several of them.
    """

    newtons: Annotated[tuple[float, float], Range(0, rising=True, unit="N")] = (50.0, 200.0)
    every_s: Annotated[tuple[float, float], Range(0, rising=True, infinite=True, unit="s")] = (1.0, 3.0)
    lasts_s: Annotated[float | tuple[float, float], Range(0, above=True, rising=True, unit="s")] = 0.2
    bodies: Annotated[tuple[int, ...], Length(1)] = (0,)
    control_hz: Positive = 30.0
    seed: int = 0
    share: Share = 1.0
    impulse_ns: Annotated[float, Range(0, above=True, infinite=True)] = float("inf")
    first_s: Annotated[float | None, Range(0, unit="s")] = None
    direction: tuple[float, float, float] | Literal["front", "any"] = "any"
    foreseen: bool = True
    name: str = "push"

    @property
    def lasting(self) -> tuple[float, float]:
        """The least and the most s that a push lasts."""
        given = self.lasts_s
        return given if isinstance(given, tuple) else (given, given)

    def enter(self, goal: Goal, backend: Backend) -> None:
        n, here = backend.num_envs, backend.device
        self._backend, self._to_left = backend, torch.tensor(goal.humanoid.left, device=here).double()
        self._rng = torch.Generator().manual_seed(self.seed)
        self.left = torch.zeros(n, dtype=torch.long, device=here)
        self.lasts = torch.zeros_like(self.left)
        self.body = torch.zeros(n, dtype=torch.long, device=here)
        self.force = torch.zeros(n, 3, dtype=backend.drive.xfrc_applied.dtype, device=here)
        self._draw(torch.arange(n, device=here), self.first_s)

    @property
    def acting(self) -> Tensor:
        """`(N,)` bool, characters that are pushed in this control step."""
        return self.left <= 0

    def begin(self, episodes: EpisodeStart) -> None:
        """Episodes begin with a time without a push; some have none at all."""
        rows = torch.arange(len(self.left), device=self.left.device)[episodes.rows]
        self._draw(rows, self.first_s)
        if self.share < 1.0:
            none = torch.rand(len(rows), generator=self._rng) >= self.share
            self.left[rows[none.to(rows.device)]] = NEVER

    def before_step(self, drive: Drive) -> bool:
        """Adds the force of each push."""
        if self.direction == "front" and bool((begins := self.left == 0).any()):
            self.force[begins] = self._against(begins)
        rows = self.acting.nonzero().squeeze(-1)
        drive.xfrc_applied[rows, self.body[rows], :3] += self.force[rows]
        return False

    def felt(self) -> Felt:
        """The pushes that act."""
        force = self.force * self.acting.unsqueeze(1)
        point = self._backend.state.xipos.gather(1, self.body.view(-1, 1, 1).expand(-1, 1, 3))
        return Felt(self.body.unsqueeze(1), point, force.unsqueeze(1))

    def after_step(self) -> None:
        """Counts down, and draws the next push where one is over."""
        self.left -= 1 if self.foreseen else self.acting.long()
        over = (self.left <= -self.lasts).nonzero().squeeze(-1)
        if self.foreseen:
            self._draw(over)
        else:
            self.left[over] = NEVER

    def rows(self) -> dict[str, Tensor]:
        return {
            f"{self.name}/left": self.left,
            f"{self.name}/lasts": self.lasts,
            f"{self.name}/body": self.body,
            f"{self.name}/force": self.force,
        }

    def state(self) -> dict[str, Tensor]:
        """The pushes, and the generator of those to come."""
        return {**super().state(), f"{self.name}/rng": self._rng.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on with the same pushes; from a task without pushes with those it has."""
        if f"{self.name}/rng" in state:
            super().load_state(state)
            self._rng.set_state(state[f"{self.name}/rng"])

    def _draw(self, ids: Tensor, first_s: float | None = None) -> None:
        """The next pushes on characters `ids (n,)`, after `first_s` where that is told."""
        n = len(ids)
        unit = torch.rand(3, n, generator=self._rng)
        pick = torch.randint(len(self.bodies), (n,), generator=self._rng)
        soonest, latest = self.every_s if first_s is None else (first_s, first_s)
        # Infinity less infinity is no number.
        wait = torch.full((n,), soonest) if soonest == latest else soonest + (latest - soonest) * unit[0]
        size = self.newtons[0] + (self.newtons[1] - self.newtons[0]) * unit[1]
        angle = 2 * torch.pi * unit[2]
        low, high = self.lasting
        lasts = torch.full((n,), low)
        if high > low:
            lasts = low * (high / low) ** torch.rand(n, generator=self._rng)
        size = size.clamp_max(self.impulse_ns / lasts)
        force = torch.stack((size * angle.cos(), size * angle.sin(), 0 * size), 1)
        if isinstance(self.direction, tuple):
            way = torch.tensor(self.direction)
            force = size.unsqueeze(1) * way / way.square().sum().sqrt()
        steps = (wait * self.control_hz).round().clamp(1, NEVER)
        self.left[ids] = steps.long().to(self.left.device)
        self.lasts[ids] = (lasts * self.control_hz).round().long().clamp_min(1).to(self.left.device)
        self.force[ids] = force.to(self.force)
        self.body[ids] = (torch.tensor(self.bodies)[pick] + 1).to(self.body.device)

    def _against(self, rows: Tensor) -> Tensor:
        """`(n, 3)` N, the forces on characters `rows (N,)` bool against where they face."""
        quat = self._backend.state.qpos[rows, 3:7].double()
        left = quat_rotate(quat, self._to_left.expand(len(quat), 3))
        # Forward is left x up.
        back = torch.stack((-left[:, 1], left[:, 0], torch.zeros_like(left[:, 0])), 1)
        size = back.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-6)
        newtons = self.force[rows].square().sum(-1, keepdim=True).sqrt()
        return (back / size * newtons).to(self.force)
