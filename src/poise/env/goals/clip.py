"""Clips as goals: the recorded path, which a gather of rows serves for any number of worlds."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from poise.env.bins import Outcomes
from poise.env.goals.goal import Goal, Group
from poise.env.plugins import Start
from poise.env.reference import Reference
from poise.env.starts import Starts
from poise.errors import PoiseError

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
        self.rate_hz, self.layout = reference.rate_hz, reference.layout
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

    def local(self, qpos: Tensor) -> Tensor:
        return self.reference.local(qpos)

    def drawn(self, by: Group) -> Tensor:
        """`(G,)` bool, groups of clips that episodes draw."""
        used = self.starts.weights > 0
        return used[self.reference.bins.clip.cpu()] if by == "bin" else used

    def draw(self, ids: Tensor) -> None:
        odds = None if self.odds is None else self.odds()
        pick, frame = (x.to(self.device) for x in self.starts.draw(len(ids), odds))
        self.clip[ids], self.frame[ids] = pick, frame

    def seek(self, clip: Tensor, frame: Tensor) -> None:
        """World i goes on at `frame[i]` of `clip[i]`, both `(N,)`, wherever its character stands."""
        self.clip.copy_(clip)
        self.frame.copy_(frame)

    def start(self, ids: Tensor | None) -> Start:
        if ids is None:
            return self.reference.coordinates(self.clip, self.frame)
        return self.reference.coordinates(self.clip[ids], self.frame[ids])

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
        return self.reference.body[self.clip if ids is None else self.clip[ids]]

    def now(self, ids: Tensor | None = None) -> Tensor:
        if ids is None:
            return self.reference.gather_packed(self.clip, self.frame)
        return self.reference.gather_packed(self.clip[ids], self.frame[ids])

    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        if k == 1:
            return self._ahead if ids is None else self._ahead[ids]
        clip, frame = (self.clip, self.frame) if ids is None else (self.clip[ids], self.frame[ids])
        return self.reference.gather_packed(clip, frame + k, told=True)

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
        return {"all": 1, "clip": len(self.reference.length), "bin": len(self.reference.bins)}[by]

    def group(self, by: Group) -> Tensor:
        return self.reference.bins.of[self._rows] if by == "bin" else self.clip

    def row(self) -> Tensor:
        return self._rows

    def outcomes(self, row: Tensor, age: Tensor, failed: Tensor, done: Tensor) -> Outcomes:
        return self.reference.bins.outcomes(row, age, failed, done)

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
        self.seek(state["clip"], state["frame"])
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
            raise PoiseError(f"environment {at} stands at {what}, which is not there")

    def rows(self) -> dict[str, Tensor]:
        return {"clip": self.clip, "frame": self.frame}
