"""Events: they happen to worlds when episodes begin and end, at control steps, at physics steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Generic, NamedTuple, Self, TypeVarTuple

import mujoco
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.bins import Outcomes
from poise.env.frame import Observable
from poise.env.goal import Goal, State
from poise.env.observations import shape_of
from poise.env.reference import Start, differing
from poise.sim import Backend, Drive, alone


class Felt(NamedTuple):
    """Forces on N characters, K on each; 0 is none.

    Attributes:
        body: `(N, K)` rows of MuJoCo's bodies, of a character alone: 1 is its root.
        point: `(N, K, 3)` m, where they act, world axes.
        force: `(N, K, 3)` N, world axes.
        driven: whether they are in the `Drive`, such as a push, or come by the physics, such as
            contacts.
        steady: whether they stay as they are for the control step.
    """

    body: Tensor
    point: Tensor
    force: Tensor
    driven: bool = True
    steady: bool = True


@dataclass(eq=False)
class EpisodeStart:
    """Episodes that begin; events change it.

    Attributes:
        ids: `(n,)` worlds, None for all.
        start: coordinates `(n, 7 + n)` and velocities `(n, 6 + n)` at which the characters are set down.
        rng: of draws.
        body: `(n,)`, which of the goal's bodies the characters are to have; None where it has one.
        kind: `(n,)`, kinds of episodes in numbers of `env.recovery`; None: ordinary ones.
        drawn: whether their kinds are to be drawn.
        seeing: worlds that see something else then, `ids` among them.
    """

    ids: Tensor | None
    start: Start
    rng: torch.Generator
    body: Tensor | None = None
    kind: Tensor | None = None
    drawn: bool = False
    seeing: Tensor | None = None

    @property
    def worlds(self) -> Tensor:
        """`ids`, for events of scenes, which are told them one by one."""
        assert self.ids is not None
        return self.ids

    @property
    def rows(self) -> Tensor | slice:
        """`ids` as an index."""
        return slice(None) if self.ids is None else self.ids


@dataclass(eq=False)
class StepOutcome:
    """The ends of episodes in one control step; events note or change it in place.

    Attributes:
        ends: `(3, N)` bool: failed, terminated, truncated.
        late: `(N,)` bool, episodes that are over by their time.
        ref: packed goals `(N, W)` of the step.
        goal: of the worlds. row: `(N,)` rows of the clips that the step led to, where they are counted.
        age: `(N,)` control steps since the episodes began.
        rng: of draws that go on; None where none may.
        counted: `(N,)` bool, worlds with outcomes that count for help and adaptive sampling; None: all.
        log: `(N,)` float32 by name.
    """

    ends: Tensor
    late: Tensor
    ref: Tensor
    goal: Goal
    row: Tensor | None
    age: Tensor
    rng: torch.Generator | None
    counted: Tensor | None = None
    log: dict[str, Tensor] = field(default_factory=dict[str, Tensor])

    @cached_property
    def ids(self) -> Tensor:
        """`(n,)` worlds in which an episode ends."""
        return (self.ends[1] | self.ends[2]).nonzero().squeeze(-1)

    @cached_property
    def bins(self) -> Outcomes:
        """Figures of the step for the clips' motion bins."""
        failed, terminated = self.ends[0], self.ends[1]
        assert self.row is not None
        bins = self.goal.clips.reference.bins
        seen = bins.outcomes(self.row, self.age, failed, terminated & ~failed)
        return seen if self.counted is None else seen.of(self.counted)


class Event(State):
    """Something that happens to N worlds; every hook may be left as it is.

    `TaskConfig.events` makes them for each environment, of its goal and backend. In a control step
    `before_step`, then `before_substep` at each physics step, then `after_step`, `judged` and `count`
    are called; and `begin` and `look` where episodes begin.
    """

    def tells(self) -> Mapping[str, Tensor | Observable]:
        """Values of a frame by name, for terms: tensors `(N, ...)`, the same ones at every step, for
        `Frame.source`, and observables, which come before those of `env.frame`."""
        return {}

    def begin(self, episodes: EpisodeStart) -> None:
        """Episodes begin; `episodes.start` may be changed."""

    def look(self, ids: Tensor | None) -> None:
        """Worlds `ids (n,)`, all for None, have been set down, or are what a snapshot holds."""

    def before_step(self, drive: Drive) -> bool:
        """A control step is about to be made: adds forces to what drives the worlds, held for it.

        Gives whether `before_substep` has anything to do in it; where no event says so, its physics
        steps are made at once.
        """
        return False

    def before_substep(self, drive: Drive) -> None:
        """Adds forces to what drives the worlds, anew before each physics step."""

    def after_step(self) -> None:
        """A control step has been made."""

    def judged(self, outcome: StepOutcome) -> None:
        """Notes, or takes back in place, what became of the episodes."""

    def count(self, outcome: StepOutcome) -> None:
        """Counts what became of the episodes, where they begin anew."""


class Force(Event):
    """An event that exerts forces to which compliance gives way."""

    def felt(self) -> Felt | None:
        """The forces on the characters; None where there are none."""
        return None


#: The things that an event is told of the worlds in which it happens, such as a goal and a backend.
Worlds = TypeVarTuple("Worlds")


class StatedEvent(Generic[*Worlds]):
    """Base of events that are dataclasses: their fields are the settings, which stay as they are.

    A task holds such an event as it is stated. Called with worlds it gives a copy that is at work in
    them, so that one statement serves many environments.
    """

    def __call__(self, *worlds: *Worlds) -> Self:
        """The event at work in these worlds."""
        event = copy(self)
        event.enter(*worlds)
        return event

    def enter(self, *worlds: *Worlds) -> None:
        """Makes everything that the event knows of its worlds."""


#: Control steps of all worlds after which failures are counted up, and what is then left of older ones.
EVERY, KEPT = 64, 0.9
#: Outcomes without a failure that every bin is taken to have had.
PRIOR = 5.0
#: With which odds a bin is practised that always fails; one that fails half of the time has 0.3.
ALWAYS_FAILS = 0.1


class AdaptiveSampling(Event):
    """How often episodes failed in each of G motion bins lately: those in which they fail are begun in
    more often.

    Attributes:
        odds: `(G,)` float64 on the CPU, with which bins are to be practised: f (1 + `ALWAYS_FAILS` - f)
            of the share f that failed, most where about every second episode fails. Bins that always
            fail are neither dwelled on nor given up.
    """

    def __init__(self, bins: int, device: torch.device | str = "cpu"):
        self._counts = torch.zeros(2, bins, dtype=torch.float64, device=device)
        self.steps = 0
        self._rate()

    def count(self, outcome: StepOutcome) -> None:
        self.add(outcome.bins)

    def add(self, seen: Outcomes) -> None:
        """One control step of all worlds."""
        # Zeros and ones are added, so that their order, which a GPU does not keep, makes no difference.
        self._counts.index_add_(1, seen.bin, torch.stack((seen.ended, seen.failed)))
        self.steps += 1
        if self.steps % EVERY == 0:
            self._rate()
            self._counts *= KEPT

    def _rate(self) -> None:
        ended, failed = self._counts.cpu()
        share = failed / (ended + PRIOR)
        self.odds = share * (1.0 + ALWAYS_FAILS - share)

    def state(self) -> dict[str, Tensor]:
        """Under "hardness", float64 `(1 + 3 G)`."""
        steps = torch.tensor([self.steps]).double()
        return {"hardness": torch.cat((steps, self.odds, self._counts.cpu().flatten()))}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from `state()`; from that of other bins as if nothing were known."""
        bins, saved = self._counts.shape[1], state.get("hardness")
        if saved is None or len(saved) != 1 + 3 * bins:
            return
        self.steps, own = int(saved[0]), saved[1:].cpu().reshape(3, bins)
        self.odds = own[0].clone()
        self._counts.copy_(own[1:])


class WorldModels:
    """Models of one structure, of which each world of a backend has one: what differs between them
    becomes a field of each world, so that the worlds are stepped together.

    Attributes:
        which: `(N,)`, the model that each world has, at first the first one.

    Args:
        backend: its own model is the first one.
        models: S of them.
        but: fields that stay as they are in each world.
    """

    def __init__(self, backend: Backend, models: Sequence[mujoco.MjModel], but: Sequence[str] = ()):
        fields = {k: v for k, v in differing(models).items() if k not in but}
        self._live = {name: backend.expand(name) for name in fields}
        self._values = {
            name: torch.from_numpy(fields[name]).to(live).view(len(models), *live.shape[1:])
            for name, live in self._live.items()
        }
        self.which = torch.zeros(backend.num_envs, dtype=torch.long, device=backend.device)

    def assign(self, rows: Tensor | None, which: Tensor) -> None:
        """Worlds `rows (n,)`, all for None, take the models `which (n,)`, before they are set down."""
        old = self.which if rows is None else self.which[rows]
        changed = (which != old).nonzero().squeeze(-1)
        if not len(changed):
            return
        ids, new = changed if rows is None else rows[changed], which[changed]
        self.which[ids] = new
        for name, live in self._live.items():
            live[ids] = self._values[name].index_select(0, new)


class BodyAssignment(Event):
    """The bodies of a backend's worlds: a world takes the body that its clip is for.

    All bodies have the same joints, hinges and shapes; lengths, sizes, masses and strengths differ, see
    `WorldModels`. A new episode only copies the numbers of its body.

    Attributes:
        body: `(N,)`, which body each world has.
        sizes: `(S, K)` float32 of the bodies, see `shape_of`.

    Args:
        backend: its model is that of the first body, which all worlds have at first.
        humanoids: S bodies.
    """

    def __init__(self, backend: Backend, humanoids: Sequence[Humanoid]):
        self._models = WorldModels(backend, [backend.model, *(alone(h) for h in humanoids[1:])])
        self.sizes = torch.stack([shape_of(h) for h in humanoids]).to(backend.device)
        self.body = self._models.which

    def tells(self) -> Mapping[str, Tensor | Observable]:
        """The sizes of each character's body."""
        return {"sizes": lambda frame: self.sizes.index_select(0, frame.place.body.long())}

    def begin(self, episodes: EpisodeStart) -> None:
        if episodes.body is not None:
            self.assign(episodes.ids, episodes.body)

    def assign(self, rows: Tensor | None, body: Tensor) -> None:
        """Worlds `rows (n,)`, all for None, take the bodies `body (n,)`, before they are set down."""
        self._models.assign(rows, body)
