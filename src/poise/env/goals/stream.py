"""A stream as a goal: frames arrive one by one, late, twice, torn or never."""

# pyright: reportUnknownMemberType=false
from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.goals.buffer import BufferedGoal
from poise.errors import PoiseError

#: m/s beyond which a root did not move but jumped.
JUMP = 12.0
#: s without a new frame after which a stream has stalled.
STALL_S = 0.25
#: Frames that are kept.
SIZE = 64


class StreamGoal(BufferedGoal):
    """Worlds follow frames that `push` gives, one control step a frame.

    `now` is the frame before the newest one that was read, so a stream knows one frame ahead; what is
    not there yet is extrapolated, and comes to rest. `notes` says it in a sentence where the stream
    stalls, jumps, sends what is no pose, or ends.

    Args:
        humanoid: frames arrive in its coordinates.
        rate_hz: frames a second, as many as control steps.
    """

    def __init__(
        self,
        humanoid: Humanoid,
        rate_hz: float,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ):
        super().__init__(humanoid, rate_hz, num_envs, SIZE, torch.device(device), seed)
        self._stalled = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        # Where bodies were told to be in the last frame; NaN where coordinates alone were told.
        bodies = len(humanoid.bodies)
        self._told = torch.full((num_envs, bodies, 3), torch.nan, device=self.device)

    def push(self, qpos: Tensor, ids: Tensor | None = None, places: Tensor | None = None) -> None:
        """The next frame, `(7 + n)` for all worlds or `(n, 7 + n)` for worlds `ids (n,)`, all for None.

        places: `(n, B, 3)` m, where bodies are to be in place of where the coordinates have them; NaN in
            worlds where that is not told.

        A frame that is not finite, or in which the root has no rotation, is left out, and noted.

        Raises:
            PoiseError: another number of coordinates, or of worlds.
        """
        ids = self._every if ids is None else ids
        width = self.humanoid.model.nq
        qpos = torch.as_tensor(qpos, dtype=torch.float64, device=self.device)
        if qpos.shape not in ((width,), (len(ids), width)):
            raise PoiseError(
                f"a frame has {width} coordinates for this body, or ({len(ids)}, {width}) for "
                f"{len(ids)} worlds, got {tuple(qpos.shape)}",
                "the stream",
            )
        qpos = qpos.expand(len(ids), width)
        norm = cast("Tensor", qpos[:, 3:7].norm(dim=-1))
        good = qpos.isfinite().all(-1) & (norm > 1e-6)
        if not bool(good.all()):
            self._note(ids[~good], "sent a frame that is no pose, which is left out")
            ids, qpos = ids[good], qpos[good]
            places = None if places is None else places[good]
        if not len(ids):
            return
        qpos = torch.cat(
            (qpos[:, :3], torch.nn.functional.normalize(qpos[:, 3:7], dim=-1), qpos[:, 7:]), -1
        )
        known = self.count[ids]
        before = self.qpos[ids, (known - 1) % SIZE]
        apart = cast("Tensor", (qpos[:, :3] - before[:, :3]).norm(dim=-1))
        jumped = (known > 0) & (apart * self.rate_hz > JUMP)
        if bool(jumped.any()):
            far = f"{float(apart[jumped].max()):.1f}"
            self._note(ids[jumped], f"jumped by {far} m between two frames; the goal is there now")
        self.append(ids, qpos, jumped)
        self._put(ids, places, jumped)
        self._stalled[ids] = False
        self._stale[ids] = True

    def _put(self, ids: Tensor, places: Tensor | None, jumped: Tensor) -> None:
        """Puts bodies of the newest frames where they are told to be; their velocities are the
        differences to the frame before, where that was told too."""
        if places is None:
            self._told[ids] = torch.nan
            return
        places = places.to(self._told)
        before = self._told[ids]
        self._told[ids] = places
        known = places.isfinite().flatten(1).all(1)
        if not bool(known.any()):
            return
        at = (self.count[ids] - 1) % self.size
        rows = self.packs[ids, at]
        # Views of the rows.
        pose = self.layout.unpacked(rows)
        pose.pos[known] = places[known]
        both = known & before.isfinite().flatten(1).all(1) & ~jumped
        pose.linvel[both] = (places[both] - before[both]) * self.rate_hz
        self.packs[ids, at] = rows

    def close(self, ids: Tensor | None = None) -> None:
        """The streams of worlds `ids`, all for None, have ended with their last frames."""
        ids = self._every if ids is None else ids
        self.last[ids] = (self.count[ids] - 1).clamp_min(0)
        self._note(ids, "ended")
        self._stale[ids] = True

    def draw(self, ids: Tensor) -> None:
        """A new episode begins at the newest frame.

        Raises:
            PoiseError: nothing has arrived yet.
        """
        self.at[ids] = self.count[ids] - 1
        if bool((self.at[ids] < 0).any()):
            raise PoiseError("nothing has arrived yet", "the stream", "Push a frame before the reset")

    def supply(self, ids: Tensor) -> None:
        late = self.at[ids] + 1 - self.count[ids]
        stalled = (late > STALL_S * self.rate_hz) & (self.at[ids] < self.last[ids])
        fresh = ids[stalled & ~self._stalled[ids]]
        if len(fresh):
            self._stalled[fresh] = True
            self._note(fresh, f"has stalled for {STALL_S:g} s; the goal comes to rest")

    def rows(self) -> dict[str, Tensor]:
        return {**super().rows(), "stalled": self._stalled, "told": self._told}

    def _note(self, ids: Tensor, what: str) -> None:
        which = "" if self.num_envs == 1 else f" of world {int(ids[0])}"
        more = f" and {len(ids) - 1} more" if len(ids) > 1 else ""
        if len(ids):
            self.notes.append(f"The stream{which}{more} {what} (frame {int(self.at[ids[0]])}).")
