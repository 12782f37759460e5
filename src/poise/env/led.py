"""A goal that leads back: an episode that has lost its clip follows a recovery motion to it, and one
that has done its clip follows one to the start of the next.

PHC tells a fallen or far character nothing but a point to come back to (`env.recovery.clock`). A
recovery motion says how: it is planned (`env.recovery.planner`) from clips that get up and clips that
walk, when it is needed, and is tracked like any other motion. So the policy that tracks a library also
recovers, and needs no other goal, reward or network for it.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from poise.env.goal import ClipGoal, Goal
from poise.env.recovery.clips import GetUpPlanner, RecoveryClips
from poise.env.recovery.planner import entry, way_into
from poise.env.reference import Reference, Start
from poise.metrics import has_lost

#: m/s of the bodies on average, below which a character has come to rest; s for which that is waited.
REST, WAITS_S = 0.5, 1.5
#: m between bodies and the first frame of the next clip, on average, with which that goes on at once.
AT_HAND = 0.15
#: What a world does.
TRACKS, FALLS, RETURNS = 0, 1, 2


class LedGoal(Goal):
    """Worlds follow their clips, and recovery motions back to them where they are lost.

    The clip waits for a character that has lost it (`metrics.has_lost`). Once that has come to rest it
    follows a recovery motion to a frame of its clip in which it hardly moves and nearly stands, and goes
    on from there. A character that loses the recovery motion gets another one.

    Args:
        goal: the clips.
        recovery_clips: of the library that the policy has learned.
        chained: worlds do all clips from theirs on, in order: a recovery motion leads from the end of
            each to the first frame of the next, wherever that stands, unless the character is there.
        returns: whether a clip that is lost is come back to; without, it goes on to its end.
        plans: whether recovery motions are planned here; a copy of such a world, in which a controller
            tries something for some steps, does without.

    Attributes:
        doing: `(N,)`, `TRACKS`, `FALLS` or `RETURNS`.
        frame: `(N,)` of the world's own clip, at which it is or waits.
        lost: (world, frame of its clip) of every time one was lost.
    """

    def __init__(
        self,
        goal: ClipGoal,
        recovery_clips: RecoveryClips,
        chained: bool = False,
        returns: bool = True,
        plans: bool = True,
    ):
        self.goal, self.reference = goal, goal.reference
        self.chained, self.returns, self.plans = chained, returns, plans
        self.humanoid, self.bodies, self.rate_hz = goal.humanoid, goal.bodies, goal.rate_hz
        self.layout, self.num_envs, self.device = goal.layout, goal.num_envs, goal.device
        self.rng, self.notes, self.begins = goal.rng, goal.notes, goal.begins
        self.get_up = GetUpPlanner(recovery_clips, self.humanoid.table, self.rate_hz)
        # From the end of a clip to the next one there is no hurry.
        self._calm = self.get_up.walks_calmly()
        self.frame, self.lost = goal.frame.clone(), list[tuple[int, int]]()
        self.doing, self._since = torch.zeros_like(goal.clip), torch.zeros_like(goal.clip)
        # How many recovery motions in a row each world has lost.
        self._vain = torch.zeros_like(goal.clip)
        # What each world follows: its recovery motion, if it is on one, and the frame of that or of its
        # clip. Recovery motions lie one after another in a table that grows.
        self._on, self.at = torch.zeros_like(goal.clip, dtype=torch.bool), goal.frame.clone()
        self._first, self._length = torch.zeros_like(goal.clip), torch.ones_like(goal.clip)
        self._packed, self._qpos = self.reference.packed(goal.clip[:0]), self.reference.qpos[:0]
        self._aimed = self._coordinates(0)

    def local(self, qpos: Tensor) -> Tensor:
        return self.goal.local(qpos)

    @property
    def clips(self) -> ClipGoal:
        return self.goal

    # --- episodes -----------------------------------------------------------------------------

    def draw(self, ids: Tensor) -> None:
        self.goal.draw(ids)
        self._begin(ids)

    def seek(self, clip: Tensor, frame: Tensor) -> None:
        self.goal.seek(clip, frame)
        self._begin(torch.arange(self.num_envs, device=self.device))

    def _begin(self, ids: Tensor) -> None:
        self.frame[ids] = self.at[ids] = self.goal.frame[ids]
        self.doing[ids], self._since[ids], self._on[ids] = TRACKS, 0, False
        self._vain[ids] = 0

    def start(self, ids: Tensor | None) -> Start:
        ids = torch.arange(self.num_envs, device=self.device) if ids is None else ids
        return self.reference.coordinates(self.goal.clip[ids], self.at[ids])

    def aimed(self) -> Tensor:
        """Coordinates `(N, 7 + n)` that the last step acted toward."""
        return self._aimed

    def _coordinates(self, k: int) -> Tensor:
        qpos = self.reference.coordinates(self.goal.clip, self.at + k)[0]
        on = self._on.nonzero().squeeze(-1)
        if len(on):
            qpos[on] = self._qpos[self._row(on, k)]
        return qpos

    def aim(self, ids: Tensor | None, held: Tensor | None) -> None:
        """Nothing is looked up beforehand."""

    def body(self, ids: Tensor | None) -> Tensor:
        return self.goal.body(ids)

    # --- frames -------------------------------------------------------------------------------

    def now(self, ids: Tensor | None = None) -> Tensor:
        return self.ahead(0, ids)

    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        ids = torch.arange(self.num_envs, device=self.device) if ids is None else ids
        packed = self.reference.gather_packed(self.goal.clip[ids], self.at[ids] + k)
        on = self._on[ids].nonzero().squeeze(-1)
        if len(on):
            packed[on] = self._packed[self._row(ids[on], k)]
        return packed

    def _row(self, ids: Tensor, k: int) -> Tensor:
        """Rows of the table that worlds `ids` are at in k steps; 0 for those without a motion."""
        return self._first[ids] + torch.minimum(self.at[ids] + k, self._length[ids] - 1)

    def targets(self) -> tuple[Tensor, Tensor]:
        every = torch.arange(self.num_envs, device=self.device)
        rows = self.reference.rows(self.goal.clip, self.at + 1)
        if not bool(self._on.any()):
            return self.reference.hinges, rows
        hinges = self.reference.hinges[rows]
        on = self._on.nonzero().squeeze(-1)
        hinges[on] = self._qpos[self._row(on, 1)][:, 7:]
        return hinges, every

    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        now = self.ahead(1)
        self._aimed = self._coordinates(1)
        # A clip waits for a character that falls.
        self.at += (self.doing != FALLS).long()
        return now, self.ahead(1)

    def watch(self, qpos: Tensor, pos: Tensor, linvel: Tensor) -> bool:
        """Notes worlds that have lost their goals, and leads those that have come to rest back and those
        that have done their clips on."""
        tracks, falls, returns = (self.doing == k for k in (TRACKS, FALLS, RETURNS))
        self.frame[tracks] = self.at[tracks]
        ref = self.layout.unpacked(self.now()).pos
        off = has_lost(pos, ref)
        lost = off & (returns | (tracks & self.returns))
        self._vain[returns & off] += 1
        self.lost += [(i, int(self.frame[i])) for i in (lost & tracks).nonzero().squeeze(-1).tolist()]
        ends = torch.where(self._on, self._length, self.reference.length[self.goal.clip]) - 1
        back = returns & ~lost & (self.at >= ends)
        self.doing[back], self._on[back], self.at[back] = TRACKS, False, self.frame[back]
        self._vain[back] = 0
        more = self.goal.clip < len(self.reference.length) - 1
        over = tracks & ~lost & (self.at >= ends) & more & (self.chained and self.plans)
        self.goal.clip[over] += 1
        self.frame[over] = self.at[over] = 0
        there = (pos - self.layout.unpacked(self.now()).pos).norm(dim=-1).mean(-1) <= AT_HAND
        rests = over & ~off & ~there
        lost |= over & off & ~there
        self.doing[lost], self._since[lost] = FALLS, 0
        self._since += 1
        late = self._since > WAITS_S * self.rate_hz
        rests |= falls & ((linvel.norm(dim=-1).mean(-1) < REST) | late) & self.plans
        # What has not fallen needs no rest.
        rests |= lost & returns & ~self.get_up.lies(qpos) & self.plans
        if bool(rests.any()):
            # Between two clips nothing waits.
            self.lead(rests.nonzero().squeeze(-1), qpos, linvel[:, 0], self.doing == TRACKS)
        self.goal.frame.copy_(self.frame)
        return bool((rests | back | falls | over).any())

    def lead(
        self, worlds: Tensor, qpos: Tensor, linvel: Tensor | None = None, calm: Tensor | None = None
    ) -> None:
        """Recovery motions for worlds `(n,)` from where they are, `qpos (N, 7 + n)` of all.

        linvel: m/s `(N, 3)`, how the roots move; by default they rest.
        calm: bool `(N,)`, which of the worlds walk without hurry; by default none.
        """
        self._tidy()
        for i in worlds.tolist():
            moves = None if linvel is None else linvel[i, :2].double().cpu()
            get_up = self.get_up if calm is None or not calm[i] else self._calm
            motion = self._motion(i, get_up, qpos[i].double().cpu(), moves)
            rows = torch.arange(motion.frames, device=self.device)
            self._first[i], self._length[i] = len(self._packed), motion.frames
            self._packed = torch.cat((self._packed, motion.packed(rows)))
            self._qpos = torch.cat((self._qpos, motion.qpos))
        self._on[worlds], self.at[worlds], self.doing[worlds] = True, 0, RETURNS

    def leave(self, worlds: Tensor) -> None:
        """Worlds `(n,)` leave their clips, and are led to the first frames of the next ones."""
        self.goal.clip[worlds] += 1
        self.frame[worlds] = self.at[worlds] = 0
        self.doing[worlds], self._since[worlds], self._on[worlds] = FALLS, 0, False
        self.goal.frame.copy_(self.frame)

    def _tidy(self) -> None:
        """Drops motions that no world is on, where they are most of the table."""
        on = self._on.nonzero().squeeze(-1)
        used = int(self._length[on].sum())
        if 2 * used >= len(self._packed):
            return
        pairs = zip(self._first[on].tolist(), self._length[on].tolist(), strict=True)
        spans = [torch.arange(first, first + length) for first, length in pairs]
        rows = torch.cat(spans).to(self.device) if spans else self._first[:0]
        self._packed, self._qpos = self._packed[rows], self._qpos[rows]
        self._first[on] = self._length[on].cumsum(0) - self._length[on]

    def _motion(self, world: int, get_up: GetUpPlanner, qpos: Tensor, moves: Tensor | None) -> Reference:
        """From `qpos (7 + n)` that moves with `moves (2)` m/s to where the world's clip is entered."""
        own, one, clip = self.reference, slice(world, world + 1), int(self.goal.clip[world])
        if self.frame[world] or not self.chained:
            self.frame[world] = entry(get_up, own, clip, int(self.frame[world]), qpos)
        place, velocity = own.coordinates(self.goal.clip[one], self.frame[one])
        there, again = (place[0].cpu(), velocity[0].cpu()), int(self._vain[world])
        way = way_into(get_up, qpos, *there, moves, again)
        found = Reference(own.humanoid, [way.numpy()], own.rate_hz, [f"recovery {world}"])
        return found.to(self.device)

    def where(self, env: int) -> str:
        kind = {TRACKS: "", FALLS: ", lost", RETURNS: ", on its recovery motion"}[int(self.doing[env])]
        return f"{self.reference.names[int(self.goal.clip[env])]} frame {int(self.frame[env])}{kind}"

    # --- persistence --------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        own = {f"led/{k}": v.clone() for k, v in self._own().items()}
        return {**self.goal.state(), **own, "led/packed": self._packed, "led/qpos": self._qpos}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.goal.load_state(state)
        for name, value in self._own().items():
            value.copy_(state[f"led/{name}"])
        self._packed, self._qpos = state["led/packed"].clone(), state["led/qpos"].clone()

    def _own(self) -> dict[str, Tensor]:
        return {
            "own_frame": self.frame, "doing": self.doing, "since": self._since, "on": self._on,
            "at": self.at, "first": self._first, "length": self._length, "vain": self._vain,
        }  # fmt: skip

    def rows(self) -> dict[str, Tensor]:
        return {**self.goal.rows(), **self._own()}

    def shared(self) -> dict[str, Tensor]:
        return {"packed": self._packed, "qpos": self._qpos}

    def load_shared(self, shared: Mapping[str, Tensor]) -> None:
        self._packed, self._qpos = shared["packed"], shared["qpos"]
