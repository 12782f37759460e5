"""Plug-ins: parts of an environment that change where episodes begin, how they end, what is seen.

An environment holds a tuple of them and names none. A plug-in overrides the hooks that it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.bins import Outcomes
from poise.env.frame import Frame, Observable
from poise.env.observations import shape_of
from poise.env.reference import Start, differing
from poise.sim import Backend, Drive, alone

if TYPE_CHECKING:
    from poise.env.goal import Goal


class Felt(NamedTuple):
    """Forces on N characters, K on each; 0 is none.

    Attributes:
        body: `(N, K)` rows of MuJoCo's bodies, of a character alone: 1 is its root.
        point: `(N, K, 3)` m, where they act, world axes.
        force: `(N, K, 3)` N, world axes.
        driven: whether they are in the `Drive`, such as a push, or come by the physics, such as
            contacts.
    """

    body: Tensor
    point: Tensor
    force: Tensor
    driven: bool = True


@dataclass(eq=False)
class EpisodesEnded:
    """What became of the episodes in one control step.

    Attributes:
        ids: `(n,)` worlds in which an episode ends.
        failed, terminated: `(N,)` bool.
        counted: `(N,)` bool, worlds with outcomes that say something of where they are in their clips;
            None: all.
    """

    ids: Tensor
    failed: Tensor
    terminated: Tensor
    age: Tensor
    goal: Goal
    rows: Tensor
    counted: Tensor | None

    @cached_property
    def bins(self) -> Outcomes:
        """What the step says of the clips' motion bins."""
        done = self.terminated & ~self.failed
        seen = self.goal.outcomes(self.rows, self.age, self.failed, done)
        return seen if self.counted is None else seen.of(self.counted)


class Plugin:
    """A part of an environment of N worlds; every hook may be left as it is."""

    @property
    def observables(self) -> Mapping[str, Observable]:
        """Observables by name; they come before those of `env.frame`."""
        return {}

    def sources(self) -> Mapping[str, Tensor]:
        """Tensors `(N, ...)` by name, for `Frame.source`; the same ones at every step."""
        return {}

    def assign(self, rows: Tensor | None, body: Tensor) -> None:
        """Worlds `rows (n,)`, all for None, take the bodies `body (n,)`, before they are set down."""

    def start(
        self, ids: Tensor | None, kind: Tensor | None, start: Start, rng: torch.Generator
    ) -> Start:
        """Changes where episodes begin in worlds `ids (n,)`, all for None.

        kind: `(n,)`, what kind of episodes, in numbers of the plug-in; None begins ordinary ones.
        """
        return start

    def placed(self, ids: Tensor | None) -> None:
        """Worlds `ids (n,)`, all for None, have been set down, or are what a snapshot holds."""

    def seeing(self, ids: Tensor) -> Tensor:
        """Worlds that see something else now that `ids (n,)` have been set down, these among them."""
        return ids

    def kinds(self, count: int, rng: torch.Generator) -> Tensor | None:
        """`(count,)` kinds of new episodes, or None where there are no kinds."""
        return None

    def held(self) -> Tensor | None:
        """`(N,)` bool, worlds with goals that wait in the next step; None: no goal waits."""
        return None

    def targets(self, hinges: Tensor) -> Tensor:
        """What additive actions add to, rad `(N, n)`, made of the goal's `hinges (N, n)`."""
        return hinges

    def push(self, drive: Drive) -> None:
        """Adds forces to what drives the worlds, held for one control step."""

    def push_substep(self, drive: Drive) -> None:
        """Adds forces to what drives the worlds, anew before each physics step."""

    def busy(self) -> bool:
        """Whether `push_substep` has anything to do in the control step that begins, asked after `push`;
        where none has, its physics steps are made at once."""
        return True

    def felt(self) -> Felt | None:
        """Forces on the characters to which compliance gives way; None where there are none."""
        return None

    def follow(self, goal: Goal) -> None:
        """The environment goes on with another goal."""

    def tick(self) -> None:
        """One control step has been made."""

    def ends(self, frame: Frame, failed: Tensor, done: Tensor) -> tuple[Tensor, Tensor]:
        """Which episodes failed and which did their clips to the end, both `(N,)` bool; recorded."""
        return failed, done

    def judged(self, ends: Tensor, ref: Tensor, late: Tensor, rng: torch.Generator | None) -> None:
        """Notes, or takes back in place, what became of the episodes.

        Args:
            ends: `(3, N)` bool: failed, terminated, truncated.
            ref: packed goals `(N, W)` of the step.
            late: `(N,)` bool, episodes that are over by their time.
            rng: draws which go on; None where none may.
        """

    def counted(self) -> Tensor | None:
        """`(N,)` bool, worlds with outcomes that count for help and adaptive sampling; None: all."""
        return None

    def count(self, ended: EpisodesEnded) -> None:
        """Notes the outcomes of one control step, where episodes begin anew."""

    def past(self, rows: Tensor) -> Tensor | None:
        """`(n,)` bool of worlds `rows (n,)` that have no past in their clips; None: all have one."""
        return None

    def log(self) -> Mapping[str, Tensor]:
        """For the log: `(N,)` float32 by name."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """What `load_state` takes, by names that no other plug-in has."""
        return {}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from `state()`, or as at first where it is not in there."""

    def rows(self) -> dict[str, Tensor]:
        """What it knows of each world, `(N, ...)` by name: tensors that a snapshot copies in place."""
        return {}


def combined(masks: Iterable[Tensor | None], how: Callable[[Tensor, Tensor], Tensor]) -> Tensor | None:
    """What several plug-ins say of the worlds, `(N,)` bool each, as one; None where none does."""
    out: Tensor | None = None
    for mask in masks:
        if mask is not None:
            out = mask if out is None else how(out, mask)
    return out


def ends_of(
    plugins: Iterable[Plugin], horizon: int, frame: Frame, failed: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Which episodes failed, are terminated and are truncated, `(N,)` bool each.

    failed: what a task's terms call a failure. horizon: control steps until an episode times out.
    """
    # A clip that is done to its end is a finished task, and its remaining return is stated: as many
    # steps like the last as `completion_bonus` says, since with nothing to come the last steps
    # would not matter and characters would fall in them. To bootstrap there would rest on a state
    # with a value that is never learned, and the policy comes to exploit it.
    done = frame.place.end > 0
    for plugin in plugins:
        failed, done = plugin.ends(frame, failed, done)
    terminated = failed | done
    return failed, terminated, (frame.source("age") >= horizon) & ~terminated


#: Control steps of all worlds after which failures are counted up, and what is then left of older ones.
EVERY, KEPT = 64, 0.9
#: Outcomes without a failure that every bin is taken to have had.
PRIOR = 5.0
#: With which odds a bin is practised that always fails; one that fails half of the time has 0.3.
ALWAYS_FAILS = 0.1


class AdaptiveSampling(Plugin):
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

    def count(self, ended: EpisodesEnded) -> None:
        self.add(ended.bins)

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


class BodyAssignment(Plugin):
    """The bodies of a backend's worlds, as a plug-in.

    Attributes:
        body: `(N,)`, which body each world has.
        sizes: `(S, K)` float32 of the bodies, see `shape_of`.

    Args:
        backend: its model is that of the first body, which all worlds have at first.
        humanoids: S bodies.
    """

    def __init__(self, backend: Backend, humanoids: Sequence[Humanoid]):
        fields = differing([backend.model, *(alone(h) for h in humanoids[1:])])
        self._live = {name: backend.expand(name) for name in fields}
        self._values = {
            name: torch.from_numpy(fields[name]).to(live).view(len(humanoids), *live.shape[1:])
            for name, live in self._live.items()
        }
        self.sizes = torch.stack([shape_of(h) for h in humanoids]).to(backend.device)
        self.body = torch.zeros(backend.num_envs, dtype=torch.long, device=backend.device)

    @property
    def observables(self) -> Mapping[str, Observable]:
        """The sizes of each character's body."""
        return {"sizes": lambda frame: self.sizes.index_select(0, frame.place.body.long())}

    def assign(self, rows: Tensor | None, body: Tensor) -> None:
        old = self.body if rows is None else self.body[rows]
        changed = (body != old).nonzero().squeeze(-1)
        if not len(changed):
            return
        ids, new = changed if rows is None else rows[changed], body[changed]
        self.body[ids] = new
        for name, live in self._live.items():
            live[ids] = self._values[name].index_select(0, new)
