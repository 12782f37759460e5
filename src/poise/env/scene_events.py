"""Scenes: what characters see and feel of the things around them, and events of these things."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, NamedTuple

import torch
from torch import Tensor

from poise.env.events import (
    EpisodeStart,
    Event,
    Felt,
    Force,
    StatedEvent,
    StepOutcome,
    WorldModels,
)
from poise.env.goal import Goal
from poise.errors import PoiseError, did_you_mean
from poise.settings import Checked, Positive, Range
from poise.sim import Backend, CharacterRows, Drive, Link, SceneSim, Touch
from poise.sim.props import Prop

#: Worlds `(N,)` bool in which something is so, such as a hand near a knob.
Condition = Callable[[SceneSim], Tensor]


class SceneEvent(StatedEvent[SceneSim, float], Event):
    """Base of `InScene.events`; `enter` gets the worlds of a scene, and its control steps a second.

    Episodes of all characters begin in worlds, see `EpisodeStart.worlds`.
    """

    def tells(self) -> Mapping[str, Tensor]:
        """Tensors of all worlds by name, for terms of one character in each."""
        return {}


class RandomEvent(SceneEvent):
    """An event with a generator of its own."""

    seed: int

    def enter(self, sim: SceneSim, control_hz: float) -> None:
        self.rng = torch.Generator().manual_seed(self.seed)

    def between(self, low: float, high: float, *shape: int) -> Tensor:
        """Numbers drawn evenly, float64 on the CPU."""
        return low + (high - low) * torch.rand(*shape, generator=self.rng, dtype=torch.float64)

    def state(self) -> dict[str, Tensor]:
        return {**super().state(), "rng": self.rng.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        super().load_state(state)
        self.rng.set_state(state["rng"])


class End(NamedTuple):
    """A touch or a link on one body of a character.

    Attributes:
        name: of the touch or link.
        link: whether it is a link.
        character: which of the rows' characters.
        body: the row of MuJoCo's bodies, of a character alone.
        sign: of the measured force, as that body feels it.
    """

    name: str
    link: bool
    character: int
    body: int
    sign: float


def ends_on(sim: SceneSim, rows: CharacterRows, name: str) -> list[End]:
    """The places at which a touch or a measured link acts on the characters of some rows.

    Raises:
        PoiseError: there is none, it is on a whole character, or on none of these.
    """
    scene = sim.scene.scene
    touch = next((t for t in scene.touches if t.name == name), None)
    link = next((x for x in scene.links if x.name == name), None)
    if touch is None and link is None:
        known = [x.name for x in (*scene.touches, *scene.links)]
        raise PoiseError(
            f"there is no touch or link '{name}'",
            "InScene",
            did_you_mean(name, known),
            code="unknown-link",
        )
    found: list[End] = []
    for body, sign in _ends(sim, name, touch):
        for k, place in enumerate(rows.places):
            if touch is not None and body == place.name:
                hint = "Touch its bodies one by one, see poise.env.scene_events.touches_of"
                raise PoiseError(
                    f"touch '{name}' does not say which body is touched",
                    "InScene",
                    hint,
                    code="touch-ambiguous",
                )
            if body in _bodies(sim, place.bodies):
                row = sim.scene.model.body(body).id - place.bodies.start + 1
                found.append(End(name, touch is None, k, row, sign))
    if not found:
        raise PoiseError(
            f"'{name}' acts on none of these characters' bodies", "InScene", code="no-bodies"
        )
    return found


def _ends(sim: SceneSim, name: str, touch: Touch | None) -> list[tuple[str, float]]:
    """The bodies of a touch or link, and the sign of the force on each."""
    if touch is not None:
        # What is measured is what `a` exerts on `b`, or on whatever it touches.
        return [(touch.a, -1.0), *([(touch.b, 1.0)] if touch.b else [])]
    sim.link(name)
    link = next(x for x in sim.scene.scene.links if x.name == name)
    return [(link.a, -1.0), (link.b, 1.0)]


def _bodies(sim: SceneSim, rows: slice) -> list[str]:
    return [sim.scene.model.body(i).name for i in range(rows.start, rows.stop)]


def touches_of(name: str, thing: str, bodies: tuple[str, ...], prefix: str = "") -> tuple[Touch, ...]:
    """A touch of `thing` with each of a character's bodies, NAME:BODY, so that it is known which one
    is touched: `Scene(touches=touches_of("hit", "ball", humanoid.bodies))`.

    prefix: what the character's bodies are called by, "anna/".
    """
    return tuple(Touch(f"{name}:{body}", thing, prefix + body) for body in bodies)


#: N; weaker forces are none.
LEAST_N = 1.0
#: s since a force was felt, at first.
LONG_S = 1e3
#: The name by which a character sees the others that share its rows.
OTHERS = "others"
_OF_OTHERS = ("qpos", "qvel", "xpos", "xquat")


@dataclass(frozen=True)
class InScene:
    """Given to `TaskConfig.events` of an environment on characters of a `SceneSim`.

    Attributes:
        sees: things that terms read by `frame.source`: "door/qpos" `(N, q)`, "door/qvel" `(N, v)`, and
            of its first body "door/pos" `(N, 3)` m and "door/quat" `(N, 4)`; "others" for the other
            characters of the same rows, "others/qpos" `(N, K - 1, q)`, likewise "qvel", "xpos", "xquat",
            the next one first.
        touches: contacts that terms read: "touch/hit" `(N, 10)`, the numbers of a `sim.Contact`.
        metered: touches of which the impulse "impulse/hit" `(N, 3)` N s and the greatest force
            "peak/hit" `(N,)` N over the last control step are measured; its physics steps are then made
            one by one.
        felt: touches and measured links on single bodies of the characters to which compliance gives
            way, see `touches_of`.
        felt_part: of a felt touch or link by its name, the part of its force `(N, 3)` N that is felt; by
            default all of it.
        events: what happens.
        ends: whether episodes end per "character", or for all characters of a "world" at once: where
            one ends, those of the others are cut off like by a time-out.
    """

    sees: tuple[str, ...] = ()
    touches: tuple[str, ...] = ()
    metered: tuple[str, ...] = ()
    felt: tuple[str, ...] = ()
    felt_part: Mapping[str, Callable[[ScenePart, Tensor], Tensor]] = field(default_factory=dict)
    events: tuple[SceneEvent, ...] = ()
    ends: Literal["character", "world"] = "character"

    def __call__(self, goal: Goal, backend: Backend) -> ScenePart:
        """The event of an environment."""
        if not isinstance(backend, CharacterRows) or backend.sim is None:
            hint = "Give the environment SceneSim(...).characters() as backend"
            raise PoiseError(
                "a task in a scene needs the characters of a scene", "InScene", hint, code="scene-needed"
            )
        return ScenePart(self, backend, backend.sim, goal.rate_hz)


class ScenePart(Force):
    """A task's part in the N worlds of a scene, for its K characters in each.

    If forces are felt, terms can read "load" `(N K,)`, N: the mean size of what is metered over the
    last control step, or else of what is felt at its end; and "since" `(N K,)`, s since that was
    `LEAST_N` or more in this episode.

    Attributes:
        events: its own ones, in order.
        sim: the worlds.
    """

    def __init__(self, given: InScene, rows: CharacterRows, sim: SceneSim, control_hz: float):
        self.given, self._rows, self.sim = given, rows, sim
        self._many = len(rows.places)
        if OTHERS in given.sees and self._many < 2:
            raise PoiseError("there are no others among these rows", "InScene", code="no-bodies")
        self.events = [make(sim, control_hz) for make in given.events]
        self._sources: dict[str, Tensor] = {}
        self._fresh, self._step_s = True, float(sim.scene.model.opt.timestep)
        self._control_s = 1.0 / control_hz
        for name in (*given.touches, *given.metered):
            sim.touch(name)
        self._feels = [end for name in given.felt for end in ends_on(sim, rows, name)]
        if self._feels:
            load = torch.zeros(rows.num_envs, device=rows.device)
            self._sources |= {"load": load, "since": torch.full_like(load, LONG_S)}
        self.look(None)
        for name in given.metered:
            force = sim.touch(name).force
            self._share(f"impulse/{name}", torch.zeros_like(force))
            self._share(f"peak/{name}", torch.zeros_like(force[:, 0]))

    def tells(self) -> Mapping[str, Tensor]:
        told = dict(self._sources)
        for event in self.events:
            told |= event.tells()
        return told

    def begin(self, episodes: EpisodeStart) -> None:
        """Events begin anew in worlds where all characters do; characters see the others of theirs."""
        k, ids = self._many, episodes.ids
        if self._feels:
            self._sources["since"][episodes.rows] = LONG_S
        if self.events:
            n = self.sim.num_envs
            every = torch.arange(n, device=self.sim.backend.device)
            worlds = every if ids is None else every[torch.bincount(ids // k, minlength=n) == k]
            for event in self.events if len(worlds) else ():
                event.begin(replace(episodes, ids=worlds))
        if ids is not None and OTHERS in self.given.sees:
            others = torch.arange(k, device=ids.device)
            episodes.seeing = (torch.unique(ids // k).unsqueeze(1) * k + others).flatten()

    def before_step(self, drive: Drive) -> bool:
        """Events before the control step; metered physics steps are made one by one."""
        for event in self.events:
            event.before_step(drive)
        self._fresh = True
        for name in self.given.metered:
            self._sources[f"impulse/{name}"].zero_()
            self._sources[f"peak/{name}"].zero_()
        return bool(self.given.metered)

    def before_substep(self, drive: Drive) -> None:
        """Notes what the physics step before it measured."""
        if not self._fresh:
            self._note()
        self._fresh = False

    def felt(self) -> Felt | None:
        """The touches and links on the characters, as the last physics step had them."""
        if not self._feels:
            return None
        n, k, like = self.sim.num_envs, len(self._feels), self.sim.backend.state.xpos
        body = torch.zeros(n * self._many, k, dtype=torch.long, device=like.device)
        point, force = (like.new_zeros(n * self._many, k, 3) for _ in range(2))
        for i, end in enumerate(self._feels):
            mine = slice(end.character, None, self._many)
            seen = self.sim.link(end.name) if end.link else self.sim.touch(end.name)
            body[mine, i], point[mine, i] = end.body, seen.point.to(like)
            part = self.given.felt_part.get(end.name)
            acts = seen.force if part is None else part(self, seen.force)
            force[mine, i] = end.sign * acts.to(like)
        return Felt(body, point, force, driven=False)

    def after_step(self) -> None:
        self._note()
        for event in self.events:
            event.after_step()
        self.look(None)
        self._weigh()

    def judged(self, outcome: StepOutcome) -> None:
        """Cuts off the episodes of the others."""
        if self.given.ends == "world" and self._many > 1:
            cut_off(outcome.ends[1], outcome.ends[2], self._many)

    def rows(self) -> dict[str, Tensor]:
        """Worlds of several characters are not copied as wholes, and neither is what happens in them."""
        if self._many > 1:
            return {}
        named = enumerate(self.events)
        out = {f"event/{i}/{k}": v for i, h in named for k, v in h.rows().items()}
        if self._feels:
            out["since"] = self._sources["since"]
        return out if self.sim.link_data is None else {**out, "links": self.sim.link_data}

    def state(self) -> dict[str, Tensor]:
        named = enumerate(self.events)
        own = {f"event/{i}/{k}": v for i, h in named for k, v in h.state().items() if k not in h.rows()}
        return {**own, **super().state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on with the same events; from a task without them with those it has."""
        super().load_state(state)
        for i, event in enumerate(self.events):
            prefix = f"event/{i}/"
            own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
            if own.keys() >= event.state().keys() - event.rows().keys():
                event.load_state(own)
        self.look(None)

    def look(self, ids: Tensor | None) -> None:
        """Brings what it tells up to date."""
        for event in self.events:
            event.look(ids)
        for name in self.given.sees:
            if name == OTHERS:
                for field in _OF_OTHERS:
                    whole = self._rows.state[field].unflatten(0, (self.sim.num_envs, self._many))
                    turned = [whole.roll(-k, 1) for k in range(1, self._many)]
                    self._keep(f"{name}/{field}", torch.stack(turned, 2).flatten(0, 1))
                continue
            place, state = self.sim.scene.place(name), self.sim.backend.state
            self._share(f"{name}/qpos", state.qpos[:, place.qpos])
            self._share(f"{name}/qvel", state.qvel[:, place.dofs])
            self._share(f"{name}/pos", state.xpos[:, place.body])
            self._share(f"{name}/quat", state.xquat[:, place.body])
        for name in self.given.touches:
            contact = self.sim.touch(name)
            numbers = contact.contacts.unsqueeze(1), contact.force, contact.torque, contact.point
            self._share(f"touch/{name}", torch.cat(numbers, 1))

    def _share(self, name: str, value: Tensor) -> None:
        """Values that all characters of a world see, `(N, ...)`."""
        self._keep(name, value.repeat_interleave(self._many, 0) if self._many > 1 else value)

    def _keep(self, name: str, value: Tensor) -> None:
        if name in self._sources:
            self._sources[name].copy_(value)
        else:
            self._sources[name] = value.float().clone()

    def _weigh(self) -> None:
        """Takes down how large the forces of the control step were."""
        felt = None if self.given.metered else self.felt()
        if not self._feels:
            return
        if felt is None:
            sums = [self._sources[f"impulse/{name}"].norm(dim=-1) for name in self.given.metered]
            load = torch.stack(sums).sum(0) / self._control_s
        else:
            load = felt.force.norm(dim=-1).sum(1)
        self._keep("load", load)
        since = self._sources["since"]
        since += self._control_s
        since[load >= LEAST_N] = 0.0

    def _note(self) -> None:
        """Adds what a physics step measured to what is metered."""
        for name in self.given.metered:
            force = self.sim.touch(name).force
            if self._many > 1:
                force = force.repeat_interleave(self._many, 0)
            self._sources[f"impulse/{name}"].add_(self._step_s * force)
            peak = self._sources[f"peak/{name}"]
            torch.maximum(peak, force.norm(dim=-1).to(peak), out=peak)


def cut_off(terminated: Tensor, truncated: Tensor, many: int) -> None:
    """Cuts off, in place, the episodes of all `many` characters of a world where one ended.

    terminated, truncated: `(N K,)` bool.
    """
    over = (terminated | truncated).view(-1, many).any(1).repeat_interleave(many)
    truncated |= over & ~terminated


G = 9.81


@dataclass
class SetDown(RandomEvent):
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

    def enter(self, sim: SceneSim, control_hz: float) -> None:
        super().enter(sim, control_hz)
        place = sim.scene.place(self.name)
        dofs = place.dofs.stop - place.dofs.start
        if len(self.qpos) != place.coordinates or len(self.qvel) not in (0, dofs):
            raise PoiseError(
                f"'{self.name}' has {place.coordinates} coordinates and {dofs} velocities, got "
                f"{len(self.qpos)} and {len(self.qvel)}",
                "SetDown",
                code="count-differs",
            )
        self._sim = sim
        self._qpos = torch.tensor(self.qpos, dtype=torch.float64)
        self._qvel = torch.tensor(self.qvel or (0.0,) * dofs, dtype=torch.float64)
        # A free body's quaternion is left as it is.
        self._moved = 3 if place.coordinates == 7 and dofs == 6 else place.coordinates

    def begin(self, episodes: EpisodeStart) -> None:
        worlds = episodes.worlds
        n, spread = len(worlds), self.spread
        qpos = self._qpos.repeat(n, 1)
        if spread:
            qpos[:, : self._moved] += self.between(-spread, spread, n, self._moved)
        here = self._sim.backend.device
        self._sim.place(self.name, qpos.to(here), self._qvel.repeat(n, 1).to(here), worlds)


@dataclass
class Varied(RandomEvent):
    """Things and links of which each world has one of several makes, drawn when its episode begins: a
    door of another width, a rod of another length. A replica of the scene is compiled for each.

    At work it has `choice` `(N,)`, the make of each world.

    Attributes:
        makes: things and links of each make, in place of those of their names; the first is that of the
            scene.
        numbers: of each make `(K, ...)`, which terms read as `(N, ...)` by these names.
        seed: of the draws.
    """

    makes: tuple[tuple[Prop | Link, ...], ...]
    numbers: Mapping[str, Tensor]
    seed: int = 0

    def enter(self, sim: SceneSim, control_hz: float) -> None:
        super().enter(sim, control_hz)
        whole, models = sim.scene.scene, [sim.scene.model]
        for make in self.makes[1:]:
            links = {x.name: x for x in make if isinstance(x, Link)}
            things = {x.name: x for x in make if not isinstance(x, Link)}
            other = replace(
                whole,
                things=tuple(things.get(x.name, x) for x in whole.things),
                links=tuple(links.get(x.name, x) for x in whole.links),
            )
            models.append(other.compile().model)
        # Links are set as they are switched on.
        self._models = WorldModels(sim.backend, models, ("eq_data",))
        self.choice = torch.zeros_like(self._models.which)
        self._told = {
            k: v.to(sim.backend.device).index_select(0, self.choice) for k, v in self.numbers.items()
        }

    def tells(self) -> Mapping[str, Tensor]:
        return self._told

    def rows(self) -> dict[str, Tensor]:
        return {"choice": self.choice}

    def begin(self, episodes: EpisodeStart) -> None:
        worlds = episodes.worlds
        drawn = torch.randint(len(self.makes), (len(worlds),), generator=self.rng)
        self.choice[worlds] = drawn.to(self.choice.device)
        self.look(None)

    def look(self, ids: Tensor | None) -> None:
        if bool((self.choice == self._models.which).all()):
            return
        self._models.assign(None, self.choice)
        for name, value in self._told.items():
            value.copy_(self.numbers[name].to(value)[self.choice])


@dataclass
class Throw(RandomEvent, Checked):
    """A free body that is thrown at another one from all around, again and again.

    It flies so that it would hit the body's centre if that kept its velocity. At work it counts `left`
    `(N,)`, control steps until the next throw, and `thrown` `(N,)`, throws of each episode.

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

    def enter(self, sim: SceneSim, control_hz: float) -> None:
        super().enter(sim, control_hz)
        if sim.scene.place(self.name).coordinates != 7:
            raise PoiseError(
                f"'{self.name}' is not free to fly",
                "Throw",
                "Throw a Ball or a Box",
                code="not-free-to-fly",
            )
        names = [sim.scene.model.body(i).name for i in range(sim.scene.model.nbody)]
        if self.at not in names:
            hint = did_you_mean(self.at, names)
            raise PoiseError(
                f"there is no body '{self.at}' in the scene", "Throw", hint, code="unknown-body"
            )
        self._sim, self._hz = sim, control_hz
        self._body = names.index(self.at)
        self.left = torch.zeros(sim.num_envs, dtype=torch.long, device=sim.backend.device)
        self.thrown = torch.zeros_like(self.left)
        self._draw(torch.arange(sim.num_envs))

    def rows(self) -> dict[str, Tensor]:
        return {"left": self.left, "thrown": self.thrown}

    def begin(self, episodes: EpisodeStart) -> None:
        self._draw(episodes.worlds)

    def _draw(self, worlds: Tensor) -> None:
        wait = self.between(*self.every_s, len(worlds)) * self._hz
        self.left[worlds] = wait.round().long().clamp_min(1).to(self.left.device)
        self.thrown[worlds] = 0

    def before_step(self, drive: Drive) -> bool:
        self.left -= 1
        now = (self.left <= 0).nonzero().squeeze(-1)
        if not len(now):
            return False
        state, n = self._sim.backend.state, len(now)
        angle, speed, up = (
            self.between(low, high, n).to(state.qpos)
            for low, high in ((0.0, 2.0 * torch.pi), self.speed, self.height)
        )
        target = state.xipos[now, self._body].to(state.qpos)
        arm = target - state.subtree_com[now, int(self._sim.scene.model.body_rootid[self._body])]
        spin, moves = state.cvel[now, self._body].split(3, -1)
        moves = moves + torch.linalg.cross(spin, arm)
        around = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), -1)
        start = target + self.distance * around
        start[:, 2] = (start[:, 2] + up).clamp_min(0.1)
        time = (self.distance / speed).unsqueeze(-1)
        velocity = (target - start) / time + moves
        velocity[:, 2:] += 0.5 * G * time
        turn = torch.zeros(n, 4).to(start)
        turn[:, 0] = 1.0
        qvel = torch.cat((velocity, torch.zeros_like(velocity)), -1)
        self._sim.place(self.name, torch.cat((start, turn), -1), qvel, now)
        seen = self.thrown[now] + 1
        self._draw(now)
        self.thrown[now] = seen
        return False


@dataclass
class Switch(SceneEvent):
    """A link that is switched on where a condition becomes true, and off where another one does.

    Attributes:
        link: its name.
        on: when, such as "the hand is near the knob"; see `near`.
        off: when it is let go; None: only when episodes begin.
    """

    link: str
    on: Condition
    off: Condition | None = None

    def enter(self, sim: SceneSim, control_hz: float) -> None:
        names = [link.name for link in sim.scene.scene.links]
        if self.link not in names:
            hint = did_you_mean(self.link, names)
            raise PoiseError(f"there is no link '{self.link}'", "Switch", hint, code="unknown-link")
        self._sim, self._row = sim, names.index(self.link)

    def begin(self, episodes: EpisodeStart) -> None:
        worlds = episodes.worlds
        begins_on = self._sim.scene.scene.links[self._row].on
        self._sim.switch(self.link, begins_on, worlds)

    def before_step(self, drive: Drive) -> bool:
        active = self._sim.backend.state["eq_active"][:, self._row].bool()
        if self.off is not None and len(rows := (active & self.off(self._sim)).nonzero().squeeze(-1)):
            self._sim.switch(self.link, False, rows)
        if len(rows := (~active & self.on(self._sim)).nonzero().squeeze(-1)):
            self._sim.switch(self.link, True, rows)
        return False


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


@dataclass
class Move(SceneEvent):
    """A thing that goes a way of its own: it is set to it at every control step, velocity and all.

    At work it counts `steps` `(N,)`, the control steps of each episode.

    Attributes:
        name: of the thing, such as a `Carrier`.
        path: of the seconds since the episode began `(N,)`, coordinates `(N, q)` and velocities
            `(N, v)`.
    """

    name: str
    path: Callable[[Tensor], tuple[Tensor, Tensor]]

    def enter(self, sim: SceneSim, control_hz: float) -> None:
        self._sim, self._hz = sim, control_hz
        self._place = sim.scene.place(self.name)
        self.steps = torch.zeros(sim.num_envs, dtype=torch.long, device=sim.backend.device)
        self._set()

    def rows(self) -> dict[str, Tensor]:
        return {"steps": self.steps}

    def begin(self, episodes: EpisodeStart) -> None:
        worlds = episodes.worlds
        self.steps[worlds] = 0
        qpos, qvel = self.path(self.steps / self._hz)
        self._sim.place(self.name, qpos[worlds], qvel[worlds], worlds)

    def before_step(self, drive: Drive) -> bool:
        self._set()
        return False

    def _set(self) -> None:
        # What follows from the state is computed by the step that comes.
        state, (qpos, qvel) = self._sim.backend.state, self.path(self.steps / self._hz)
        state.qpos[:, self._place.qpos] = qpos.to(state.qpos)
        state.qvel[:, self._place.dofs] = qvel.to(state.qvel)

    def after_step(self) -> None:
        self.steps += 1
