"""Events: what happens in the worlds of a scene, when episodes begin, at intervals, on conditions."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from poise.env.goal import Goal
from poise.env.plugins import Felt, Plugin
from poise.env.reference import Start
from poise.errors import PoiseError, did_you_mean
from poise.sim import Backend, CharacterRows, Drive, SceneSim, Touch

#: Worlds `(N,)` bool in which something is so, such as a hand near a knob.
Condition = Callable[[SceneSim], Tensor]


class Event(Protocol):
    """The settings of an event, given to `InScene.events`."""

    def __call__(self, sim: SceneSim, control_hz: float) -> Happening:
        """The event in the worlds of a scene; a PoiseError for what is not in it."""
        ...


class Happening:
    """An event in N worlds; every hook may be left as it is."""

    def begin(self, worlds: Tensor) -> None:
        """Episodes of all characters begin in `worlds (n,)`."""

    def before(self) -> None:
        """A control step is about to be made."""

    def after(self) -> None:
        """A control step has been made."""

    def rows(self) -> dict[str, Tensor]:
        """What it knows of each world, `(N, ...)` by name: tensors that a snapshot copies in place."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """What all worlds share, such as a generator's state."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Goes on from `state()`."""


class RandomEvent(Happening):
    """An event with a generator of its own."""

    def __init__(self, seed: int):
        self.rng = torch.Generator().manual_seed(seed)

    def between(self, low: float, high: float, *shape: int) -> Tensor:
        """Numbers drawn evenly, float64 on the CPU."""
        return low + (high - low) * torch.rand(*shape, generator=self.rng, dtype=torch.float64)

    def state(self) -> dict[str, Tensor]:
        return {"rng": self.rng.get_state()}

    def load_state(self, state: dict[str, Tensor]) -> None:
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
    """Where a touch or a measured link acts on the characters of some rows.

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
                hint = "Touch its bodies one by one, see poise.env.events.touches_of"
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


#: The name by which a character sees the others that share its rows.
OTHERS = "others"
_OF_OTHERS = ("qpos", "qvel", "xpos", "xquat")


@dataclass(frozen=True)
class InScene:
    """Given to `TaskConfig.plugins` of an environment on characters of a `SceneSim`.

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
    events: tuple[Event, ...] = ()
    ends: Literal["character", "world"] = "character"

    def __call__(self, goal: Goal, backend: Backend) -> ScenePart:
        """The plug-in of an environment."""
        if not isinstance(backend, CharacterRows) or backend.sim is None:
            hint = "Give the environment SceneSim(...).characters() as backend"
            raise PoiseError(
                "a task in a scene needs the characters of a scene", "InScene", hint, code="scene-needed"
            )
        kind = MeteredPart if self.metered else ScenePart
        return kind(self, backend, backend.sim, goal.rate_hz)


class ScenePart(Plugin):
    """A task's part in the N worlds of a scene, for its K characters in each.

    Attributes:
        happenings: its events, in order.
        sim: the worlds.
    """

    def __init__(self, given: InScene, rows: CharacterRows, sim: SceneSim, control_hz: float):
        self.given, self._rows, self.sim = given, rows, sim
        self._many = len(rows.places)
        if OTHERS in given.sees and self._many < 2:
            raise PoiseError("there are no others among these rows", "InScene", code="no-bodies")
        self.happenings = [make(sim, control_hz) for make in given.events]
        self._sources: dict[str, Tensor] = {}
        for name in (*given.touches, *given.metered):
            sim.touch(name)
        self._feels = [end for name in given.felt for end in ends_on(sim, rows, name)]
        self._look()

    def sources(self) -> Mapping[str, Tensor]:
        return self._sources

    def start(
        self, ids: Tensor | None, kind: Tensor | None, start: Start, rng: torch.Generator
    ) -> Start:
        """Events begin anew in worlds where all characters do."""
        if self.happenings:
            n, k = self.sim.num_envs, self._many
            every = torch.arange(n, device=self.sim.backend.device)
            worlds = every if ids is None else every[torch.bincount(ids // k, minlength=n) == k]
            for happening in self.happenings if len(worlds) else ():
                happening.begin(worlds)
        return start

    def placed(self, ids: Tensor | None) -> None:
        self._look()

    def seeing(self, ids: Tensor) -> Tensor:
        """Characters see the others of their worlds."""
        if OTHERS not in self.given.sees:
            return ids
        k, others = self._many, torch.arange(self._many, device=ids.device)
        return (torch.unique(ids // k).unsqueeze(1) * k + others).flatten()

    def push(self, drive: Drive) -> None:
        """What happens before the control step."""
        for happening in self.happenings:
            happening.before()

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

    def tick(self) -> None:
        for happening in self.happenings:
            happening.after()
        self._look()

    def judged(self, ends: Tensor, ref: Tensor, late: Tensor, rng: torch.Generator | None) -> None:
        """Cuts off the episodes of the others."""
        if self.given.ends == "world" and self._many > 1:
            cut_off(ends[1], ends[2], self._many)

    def rows(self) -> dict[str, Tensor]:
        """Worlds of several characters are not copied as wholes, and neither is what happens in them."""
        if self._many > 1:
            return {}
        named = enumerate(self.happenings)
        out = {f"event/{i}/{k}": v for i, h in named for k, v in h.rows().items()}
        return out if self.sim.link_data is None else {**out, "links": self.sim.link_data}

    def state(self) -> dict[str, Tensor]:
        named = enumerate(self.happenings)
        own = {f"event/{i}/{k}": v for i, h in named for k, v in h.state().items()}
        return {**own, **{k: v.clone() for k, v in self.rows().items()}}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on with the same events; from a task without them with those it has."""
        for name, value in self.rows().items():
            if name in state:
                value.copy_(state[name])
        for i, happening in enumerate(self.happenings):
            prefix = f"event/{i}/"
            own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
            if own.keys() >= happening.state().keys():
                happening.load_state(own)
        self._look()

    def _look(self) -> None:
        """Brings the sources up to date."""
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
        """What all characters of a world see, `(N, ...)`."""
        self._keep(name, value.repeat_interleave(self._many, 0) if self._many > 1 else value)

    def _keep(self, name: str, value: Tensor) -> None:
        if name in self._sources:
            self._sources[name].copy_(value)
        else:
            self._sources[name] = value.float().clone()


class MeteredPart(ScenePart):
    """The same, with impulses and greatest forces of touches over each control step."""

    def __init__(self, given: InScene, rows: CharacterRows, sim: SceneSim, control_hz: float):
        self._fresh, self._step_s = True, float(sim.scene.model.opt.timestep)
        super().__init__(given, rows, sim, control_hz)
        for name in given.metered:
            force = sim.touch(name).force
            self._share(f"impulse/{name}", torch.zeros_like(force))
            self._share(f"peak/{name}", torch.zeros_like(force[:, 0]))

    def push(self, drive: Drive) -> None:
        super().push(drive)
        self._fresh = True
        for name in self.given.metered:
            self._sources[f"impulse/{name}"].zero_()
            self._sources[f"peak/{name}"].zero_()

    def push_substep(self, drive: Drive) -> None:
        """Notes what the physics step before it measured."""
        if not self._fresh:
            self._note()
        self._fresh = False

    def tick(self) -> None:
        self._note()
        super().tick()

    def _note(self) -> None:
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
