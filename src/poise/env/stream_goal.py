"""Goals of which only some frames are known, as they come: a stream's arrive late, twice or never."""

# pyright: reportUnknownMemberType=false
from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from functools import partial
from typing import cast

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.evaluate import Recorded
from poise.env.goal import Goal, extrapolated
from poise.env.reference import Poser, Start
from poise.errors import PoiseError
from poise.sim import difference


class BufferedGoal(Goal):
    """Worlds read along the last L frames of N motions.

    Frames are counted from 0 on; frames before the last L are forgotten and read as the oldest that is
    kept; frames beyond the last are extrapolated.

    Velocities are differences to the frame before, so that none waits for a frame to come: a stream's
    last frame has one, too. The first frame stands still.

    Attributes:
        at: `(N,)` the frame that each world is at.
        qpos: `(N, L, 7 + n)`, frame k at k mod L.
        qvel: `(N, L, 6 + n)`, the velocities there.
        packs: `(N, L, W)` packed poses there, so that each frame becomes a pose once.
        count: `(N,)` how many frames are known.
        low: `(N,)` the lowest root height so far, m.
        last: `(N,)` index of the last frame of all, where that is known; else far away.
    """

    def __init__(
        self,
        humanoid: Humanoid,
        rate_hz: float,
        num_envs: int,
        size: int,
        device: torch.device,
        seed: int,
    ):
        self.humanoid, self.bodies, self.rate_hz = humanoid, (humanoid,), rate_hz
        self.num_envs, self.device, self.size, self.notes = num_envs, device, size, []
        self.rng = torch.Generator().manual_seed(seed)
        # Frames become poses on the CPU; what terms ask for is worked out where the worlds are.
        self._poser, self.local = Poser(humanoid), Poser(humanoid, device).local
        self.layout = self._poser.layout()
        nq, nv = humanoid.model.nq, humanoid.model.nv
        self.qpos = torch.zeros(num_envs, size, nq, dtype=torch.float64, device=device)
        self.qpos[..., 3] = 1.0
        self.qvel = torch.zeros(num_envs, size, nv, dtype=torch.float64, device=device)
        self.packs = torch.zeros(num_envs, size, self.layout.width, device=device)
        self.at = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.count, self._wait = torch.zeros_like(self.at), torch.zeros_like(self.at)
        self.low = torch.full((num_envs,), torch.inf, dtype=torch.float64, device=device)
        self.last = torch.full_like(self.count, 2**62)
        self._every = torch.arange(num_envs, device=device)
        self._moves = Recorded(partial(_moves, rate_hz))
        self._reads = Recorded(partial(_reads, size))
        self._ahead, self._hinges = self.packed(self._every, self.at), self.qpos[:, 0, 7:].clone()
        # Worlds with a next frame that may have changed since it was looked up.
        self._stale = torch.zeros(num_envs, dtype=torch.bool, device=device)

    # --- what is known ------------------------------------------------------------------------

    def clear(self, ids: Tensor) -> None:
        """Worlds `ids (n,)` know no frame."""
        self.count[ids], self.last[ids], self.low[ids] = 0, 2**62, torch.inf

    def append(self, ids: Tensor, qpos: Tensor, still: Tensor | None = None) -> None:
        """One more frame `qpos (n, 7 + n)` in worlds `ids (n,)`.

        still: `(n,)` bool, frames that have no velocity, such as those after a jump.
        """
        count = self.count[ids]
        at = count % self.size
        before = self.qpos[ids, (count - 1) % self.size]
        none = count == 0 if still is None else (count == 0) | still
        (qvel,) = self._moves(qpos, before, none)
        self.qvel[ids, at], self.qpos[ids, at] = qvel, qpos
        self.packs[ids, at] = self._pack(qpos, qvel)
        self.low[ids] = torch.minimum(self.low[ids], qpos[:, 2])
        self.count[ids] += 1

    def extend(self, ids: Tensor, qpos: Tensor) -> None:
        """Several more frames `qpos (n, f, 7 + n)` in worlds `ids (n,)`, at most as many as are kept."""
        (n, frames), at = qpos.shape[:2], self.count[ids]
        before = torch.cat((self.qpos[ids, (at - 1) % self.size][:, None], qpos[:, :-1]), 1)
        qvel = (difference(qpos.flatten(0, 1), before.flatten(0, 1)) * self.rate_hz).view(n, frames, -1)
        qvel[at == 0, 0] = 0.0
        rows, index = ids[:, None], at[:, None] + torch.arange(frames, device=self.device)
        self.qvel[rows, index % self.size], self.qpos[rows, index % self.size] = qvel, qpos
        packs = self._pack(qpos.flatten(0, 1), qvel.flatten(0, 1))
        self.packs[rows, index % self.size] = packs.view(n, frames, -1)
        self.low[ids] = torch.minimum(self.low[ids], qpos[..., 2].amin(1))
        self.count[ids] += frames

    def posed(self, qpos: Tensor) -> tuple[Tensor, Tensor]:
        """Another motion `(f, 7 + n)`, and its packed poses `(f, W)` as this goal has its own."""
        qvel = torch.zeros(len(qpos), self.qvel.shape[-1]).to(qpos)
        qvel[1:] = difference(qpos[1:], qpos[:-1]) * self.rate_hz
        packs = self._pack(qpos, qvel)
        self.layout.place(packs).low.fill_(float(qpos[:, 2].min()))
        return qpos, packs

    def coordinates(self, ids: Tensor, index: Tensor) -> Start:
        """qpos `(n, 7 + n)` and qvel `(n, 6 + n)` of frames `index (n,)` of worlds `ids (n,)`."""
        known = self.count[ids]
        kept = torch.minimum(index, self.last[ids])
        at = torch.minimum(kept, known - 1).clamp_min(0)
        at = torch.maximum(at, known - self.size).clamp_min(0)
        qpos, qvel = self.qpos[ids, at % self.size], self.qvel[ids, at % self.size]
        beyond = (kept - at).clamp_min(0) * (kept >= known)
        if not bool((beyond > 0).any()):
            return qpos, qvel
        return extrapolated(qpos, qvel, beyond, self.rate_hz)

    def packed(self, ids: Tensor, index: Tensor) -> Tensor:
        """Packed poses `(n, W)` of frames `index (n,)`; the place says where the motion ends."""
        out, unknown = self._reads(self.packs, self.count, self.last, self.low, ids, index)
        beyond = unknown.nonzero().squeeze(-1)
        if not len(beyond):
            return out
        # Recordings give what is not to be written into.
        out = out.clone()
        out[beyond, :-4] = self._pack(*self.coordinates(ids[beyond], index[beyond]))[:, :-4]
        return out

    def _pack(self, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Packed poses `(n, W)` of coordinates; their place is yet to be told."""
        pose = self._poser.live(qpos.cpu(), qvel.cpu())
        return self.layout.pack(pose, torch.zeros(len(qpos), 4)).to(self.device)

    # --- what a goal tells --------------------------------------------------------------------

    def _begun(self, ids: Tensor | None, clip: Tensor | None) -> Tensor:
        """The worlds that begin; where a clip is asked for, `clips` says that there are none."""
        if clip is not None:
            self.clips.reset(ids, clip)
        return self._every if ids is None else ids

    @abstractmethod
    def supply(self, ids: Tensor) -> None:
        """Frames for worlds `ids (n,)` that are about to be read, as far as there are any."""

    def start(self, ids: Tensor | None = None, later: int = 0) -> Start:
        ids = self._every if ids is None else ids
        return self.coordinates(ids, self.at[ids] + later)

    def aim(self, ids: Tensor | None, held: Tensor | None) -> None:
        ids = self._every if ids is None else ids
        self._wait = torch.zeros_like(self.at) if held is None else held.long()
        self.supply(ids)
        self._stale[ids] = True

    def _look(self) -> None:
        """Looks up the next frames where they may have changed."""
        ids = self._stale.nonzero().squeeze(-1)
        if not len(ids):
            return
        index = self.at[ids] + 1 - self._wait[ids]
        self._ahead = self._ahead.clone()
        self._ahead[ids] = self.packed(ids, index)
        self._hinges[ids] = self.coordinates(ids, index)[0][:, 7:]
        self._stale[ids] = False

    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        if k == 1:
            self._look()
            return self._ahead if ids is None else self._ahead[ids]
        ids = self._every if ids is None else ids
        return self.packed(ids, self.at[ids] + k)

    def window(self, steps: tuple[int, ...], ids: Tensor | None = None) -> Tensor:
        ids = self._every if ids is None else ids
        at, known = self.at[ids], self.count[ids] - 1
        # Where nothing follows, what `ahead` tells, which is extrapolated.
        last = torch.maximum(known, at + 1)
        index = torch.minimum(at[:, None] + torch.tensor(steps, device=self.device), last[:, None])
        # All of them at once: each look-up costs as much for one frame as for many.
        found = self.packed(ids.repeat_interleave(len(steps)), index.flatten())
        return found.view(len(ids), len(steps), -1)

    def targets(self) -> tuple[Tensor, Tensor]:
        self._look()
        return self._hinges, self._every

    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        now = self.ahead()
        self.at += 1 if waited is None else 1 - waited.long()
        self.aim(None, held)
        return now, self.ahead()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        super().load_state(state)
        self._stale[:] = True

    def rows(self) -> dict[str, Tensor]:
        names = ("at", "qpos", "qvel", "packs", "count", "last", "low")
        return {name: getattr(self, name) for name in names}


def _moves(rate_hz: float, qpos: Tensor, before: Tensor, none: Tensor) -> tuple[Tensor]:
    """qvel `(n, 6 + n)` from `before (n, 7 + n)` to `qpos` in a step; nothing where `none (n,)`."""
    return (torch.where(none.unsqueeze(-1), 0.0, difference(qpos, before) * rate_hz),)


def _reads(
    size: int, packs: Tensor, count: Tensor, last: Tensor, low: Tensor, ids: Tensor, index: Tensor
) -> tuple[Tensor, Tensor]:
    """Packed poses `(n, W)` of those frames that are known, and `(n,)` bool, which are not."""
    known, end = count[ids], last[ids]
    kept = torch.minimum(index, end)
    at = torch.maximum(torch.minimum(kept, known - 1), known - size).clamp_min(0)
    rows, lowest = packs[ids, at % size], low[ids]
    lowest = torch.where(lowest.isfinite(), lowest, 0.0).to(rows)
    none, ends = torch.zeros_like(lowest), (index >= end).to(rows)
    out = torch.cat((rows[:, :-4], torch.stack((none, lowest, ends, none), 1)), 1)
    return out, (kept >= known) | (known == 0)


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
                code="wrong-shape",
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

    def reset(self, ids: Tensor | None, clip: Tensor | None = None, frame: Tensor | None = None) -> None:
        """A new episode begins at the newest frame.

        Raises:
            PoiseError: nothing has arrived yet, or a clip is asked for.
        """
        ids = self._begun(ids, clip)
        self.at[ids] = self.count[ids] - 1
        if bool((self.at[ids] < 0).any()):
            raise PoiseError(
                "nothing has arrived yet",
                "the stream",
                "Push a frame before the reset",
                code="nothing-arrived",
            )

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
