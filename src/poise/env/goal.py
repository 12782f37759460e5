"""Goals tell N characters their motion as it goes; and clips as goals."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.frame import PoseLayout
from poise.env.starts import Starts
from poise.errors import PoiseError
from poise.sim import displaced

if TYPE_CHECKING:
    from poise.env.reference import Reference, Start

#: s in which an extrapolated motion comes to rest: its velocity falls by e in each.
FADE_S = 0.1

Group = Literal["all", "clip", "bin"]


class State:
    """Something with a state that snapshots and checkpoints copy."""

    def rows(self) -> dict[str, Tensor]:
        """Its knowledge of each world, `(N, ...)` by name: tensors that a snapshot copies in place."""
        return {}

    def shared(self) -> dict[str, Tensor]:
        """Tables that `rows` point into, by name: never changed in place; a snapshot holds them."""
        return {}

    def load_shared(self, shared: Mapping[str, Tensor]) -> None:
        """Takes what another one of the kind has as `shared()`, for all worlds."""

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs, by names that nothing else has."""
        return {name: value.clone() for name, value in self.rows().items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues from `state()`; what is not in there stays as it is."""
        for name, value in self.rows().items():
            if name in state:
                value.copy_(state[name])


class Goal(State, ABC):
    """The motion that N characters are to do, told as it goes.

    An environment asks for the frame that the characters are to be in `now` and for those `ahead`;
    `extrapolated` makes the frames beyond those that are known, for all goals alike. So a control policy
    cannot tell which goal it follows: a clip, a stream, a generator, or one of these displaced.

    Attributes:
        humanoid: the goal is in its coordinates; the first of `bodies`.
        bodies: all bodies, of the same joints and hinges.
        rate_hz: control steps a second.
        layout: where the numbers of packed poses `(N, W)` stand, see `PoseLayout`.
        local: `(N, J, 4)` wxyz local turns of the hinged bodies of coordinates `(N, 7 + n)`.
        num_envs: N.
        device: where its tensors are.
        rng: of all draws that starts make, on the CPU.
        notes: sentences on what went wrong, in order; a stream that stalls, for instance.
    """

    humanoid: Humanoid
    bodies: tuple[Humanoid, ...]
    rate_hz: float
    layout: PoseLayout
    local: Callable[[Tensor], Tensor]
    num_envs: int
    device: torch.device
    rng: torch.Generator
    notes: list[str]
    #: Whether the goal is known before the first episode, so that characters can be set down on it.
    begins: bool = False
    #: Whether it looks where characters are, see `watch`.
    watches: bool = False

    # --- episodes -----------------------------------------------------------------------------

    @abstractmethod
    def reset(self, ids: Tensor | None, clip: Tensor | None = None, frame: Tensor | None = None) -> None:
        """New episodes in worlds `ids (n,)`, all for None, as they are drawn; or at `frame (n,)` of
        `clip (n,)`, wherever the characters stand.

        Raises:
            PoiseError: a clip is given, and the goal follows none.
        """

    @abstractmethod
    def start(self, ids: Tensor | None = None, later: int = 0) -> Start:
        """Coordinates of the goal in worlds `ids`, all for None, in which episodes begin; or those of so
        many control steps later."""

    @abstractmethod
    def aim(self, ids: Tensor | None, held: Tensor | None) -> None:
        """Looks up what comes next in worlds `ids`, all for None, after they have been set down.

        held: `(N,)` bool, worlds with goals that wait in the next step; None: no goal waits.
        """

    # --- frames -------------------------------------------------------------------------------

    @abstractmethod
    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        """Packed poses `(n, W)` of k control steps later; extrapolated where they are not known. 0 is
        where the characters are to be now."""

    def window(self, steps: tuple[int, ...], ids: Tensor | None = None) -> Tensor:
        """Packed poses `(n, K, W)` of so many control steps later; what a stream does not know yet is
        told as the last frame that it knows."""
        return torch.stack([self.ahead(k, ids) for k in steps], 1)

    @abstractmethod
    def targets(self) -> tuple[Tensor, Tensor]:
        """Hinge angles of `ahead(1)`, rad float64, as a table `(R, n)` and its rows `(N,)`."""

    @abstractmethod
    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        """One control step has been made; `now()` and `ahead(1)` of all worlds.

        waited, held: `(N,)` bool, worlds with goals that waited in this step, and that wait in the next.
        """

    def watch(self, qpos: Tensor, pos: Tensor, linvel: Tensor) -> bool:
        """Looks where the characters are, before a policy acts; True if goals changed by that.

        qpos `(N, 7 + n)`; pos `(N, B, 3)` m and linvel `(N, B, 3)` m/s of their bodies.
        """
        return False

    # --- what every goal can be asked ---------------------------------------------------------

    def now(self, ids: Tensor | None = None) -> Tensor:
        """Packed poses `(n, W)` that the characters are to be in now."""
        return self.ahead(0, ids)

    @property
    def clips(self) -> ClipGoal:
        """The clips that the goal is made of.

        Raises:
            PoiseError: it is made of none.
        """
        raise PoiseError(f"a {type(self).__name__} follows no clips", code="goal-without-clips")

    def where(self, env: int) -> str:
        """The part of the goal that world `env` is at, for messages."""
        return type(self).__name__

    # --- persistence --------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        return {**{f"goal/{k}": v.clone() for k, v in self.rows().items()}, "rng": self.rng.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        for name, value in self.rows().items():
            value.copy_(state[f"goal/{name}"])
        self.rng.set_state(state["rng"])


def extrapolated(qpos: Tensor, qvel: Tensor, steps: Tensor, rate_hz: float) -> Start:
    """Where a motion goes on that is known up to `qpos (n, 7 + n)` with `qvel (n, 6 + n)`.

    Its velocity fades, q = q_0 + v_0 tau (1 - e^(-t / tau)), v = v_0 e^(-t / tau) with tau = `FADE_S`,
    so that a character comes to rest where it was heading if its goals stop arriving.

    steps: `(n,)` control steps beyond the last known frame.
    """
    left = torch.exp(-steps.to(qpos) / (rate_hz * FADE_S)).unsqueeze(-1)
    return displaced(qpos, qvel * (FADE_S * (1.0 - left))), qvel * left


#: Frames behind the end of a clip at which a character that waits there may stand.
BEHIND = 100_000


class ClipGoal(Goal):
    """Every world follows one of the reference's clips.

    Attributes:
        reference: the clips.
        clip, frame: `(N,)` which clip each world follows, and the frame that it is at.
        starts: draws where episodes begin.
        odds: gives the odds of motion bins with which starts are drawn, see `Starts.draw`; None: none.
    """

    def __init__(self, reference: Reference, num_envs: int, device: torch.device, starts: Starts):
        self.reference = reference = reference.to(device)
        self.humanoid, self.bodies = reference.humanoid, reference.bodies
        self.rate_hz, self.layout, self.local = reference.rate_hz, reference.layout, reference.local
        self.num_envs, self.device, self.starts = num_envs, device, starts
        self.rng, self.notes = starts.rng, []
        self.odds: Callable[[], Tensor] | None = None
        self.clip = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.frame = torch.zeros(num_envs, dtype=torch.long, device=device)
        # The rows of what comes next, and its packed poses as policies are told them.
        self._rows, self._ahead = self.clip.clone(), reference.packed(self.clip)

    begins = True

    @property
    def clips(self) -> ClipGoal:
        return self

    def drawn(self, by: Group) -> Tensor:
        """`(G,)` bool, groups of clips that episodes draw."""
        used = self.starts.weights > 0
        return used[self.reference.bins.clip.cpu()] if by == "bin" else used

    def reset(self, ids: Tensor | None, clip: Tensor | None = None, frame: Tensor | None = None) -> None:
        rows = slice(None) if ids is None else ids
        if clip is None or frame is None:
            odds = None if self.odds is None else self.odds()
            clip, frame = self.starts.draw(self.num_envs if ids is None else len(ids), odds)
        self.clip[rows], self.frame[rows] = clip.to(self.device), frame.to(self.device)

    def start(self, ids: Tensor | None = None, later: int = 0) -> Start:
        clip, frame = (self.clip, self.frame) if ids is None else (self.clip[ids], self.frame[ids])
        return self.reference.coordinates(clip, frame + later)

    def aim(self, ids: Tensor | None, held: Tensor | None) -> None:
        ahead = self.frame + 1 if held is None else self.frame + 1 - held.long()
        if ids is None:
            self._rows = self.reference.rows(self.clip, ahead)
            self._ahead = self.reference.gather_packed(self.clip, ahead, self._rows, told=True)
        else:
            clip, ahead = self.clip[ids], ahead[ids]
            self._rows[ids] = self.reference.rows(clip, ahead)
            self._ahead[ids] = self.reference.gather_packed(clip, ahead, told=True)

    def body(self, ids: Tensor | None) -> Tensor:
        """`(n,)` which of `bodies` the characters of worlds `ids` need."""
        return self.reference.body[self.clip if ids is None else self.clip[ids]]

    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        if k == 1:
            return self._ahead if ids is None else self._ahead[ids]
        clip, frame = (self.clip, self.frame) if ids is None else (self.clip[ids], self.frame[ids])
        # Noise misleads what is to come, and never the judgement of what was done.
        return self.reference.gather_packed(clip, frame + k, told=k > 0)

    def targets(self) -> tuple[Tensor, Tensor]:
        return self.reference.hinges, self._rows

    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        self.frame += 1
        if waited is not None:
            self.frame.sub_(waited.long())
        now = self._ahead
        if self.reference.misleads:
            now = self.reference.gather_packed(self.clip, self.frame, self._rows)
        self._rows, self._ahead = self.reference.follow(self._rows, self.clip, self.frame, held)
        return now, self._ahead

    def groups(self, by: Group) -> int:
        """How many groups of outcomes there are, see `HelpBudget`."""
        return {"all": 1, "clip": len(self.reference.length), "bin": len(self.reference.bins)}[by]

    def group(self, by: Group) -> Tensor:
        """`(N,)` the group of each world in the present step, of clips or bins."""
        return self.reference.bins.of[self._rows] if by == "bin" else self.clip

    @property
    def row(self) -> Tensor:
        """`(N,)` the rows of the reference that the present step leads to."""
        return self._rows

    def where(self, env: int) -> str:
        return f"{self.reference.names[int(self.clip[env])]} frame {int(self.frame[env])}"

    def state(self) -> dict[str, Tensor]:
        return {
            "clip": self.clip.clone(),
            "frame": self.frame.clone(),
            "weights": self.starts.weights,
            "rng": self.rng.get_state(),
        }

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self._check(state["clip"], state["frame"])
        self.reset(None, state["clip"], state["frame"])
        if "weights" in state:  # States of former versions are without; their odds never changed.
            self.starts.weights = state["weights"]
        self.rng.set_state(state["rng"])

    def _check(self, clip: Tensor, frame: Tensor) -> None:
        """Refuses clips that are not there, and frames before the first or far behind the last."""
        clip, frame = clip.to(self.device), frame.to(self.device)
        known = (clip >= 0) & (clip < len(self.reference.length)) & (frame >= 0)
        place = clip * known
        known &= self.reference.cyclic[place] | (frame < self.reference.length[place] + BEHIND)
        if not known.all():
            at = int((~known).nonzero()[0, 0])
            what = f"frame {int(frame[at])} of clip {int(clip[at])}"
            raise PoiseError(
                f"environment {at} stands at {what}, which is not there", code="frame-outside"
            )

    def rows(self) -> dict[str, Tensor]:
        return {"clip": self.clip, "frame": self.frame}
