"""A goal that is come back to: a character that has lost it falls, rests, and follows a recovery motion.

PHC tells a fallen or far character nothing but a point to come back to (`env.recovery.clock`). A
recovery motion says how: it is planned (`env.recovery.planner`) from clips that get up and clips that
walk, when it is needed, and is tracked like any other motion. So the policy that tracks a library also
recovers, and needs no other goal, reward or network for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from poise.env.generator_goal import GeneratorGoal
from poise.env.goal import ClipGoal, Goal
from poise.env.recovery.get_up import GetUpPlanner, RecoveryClips
from poise.env.recovery.planner import entry, way_into, way_to_stand
from poise.env.recovery.seats import Seats
from poise.env.reference import Reference, Start
from poise.metrics import has_lost

#: m/s of the bodies on average, below which a character has come to rest; s for which that is waited.
REST, WAITS_S = 0.5, 1.5
#: m between bodies and the first frame of the next clip, on average, with which that goes on at once.
AT_HAND = 0.15
#: Phases of a character: it follows its goal, it fell and the goal waits, it is on a recovery motion.
TRACKS, FALLS, RETURNS = 0, 1, 2


class PhaseChange(NamedTuple):
    """The changes of one control step, `(N,)` bool each: characters that have lost what they followed,
    those for which a recovery motion may begin, and those that have come to the end of theirs."""

    lost: Tensor
    rests: Tensor
    back: Tensor


class RecoveryPhases:
    """The one state machine of falls: `TRACKS` -> `FALLS` -> `RETURNS` -> `TRACKS`.

    Attributes:
        doing: `(N,)`, the phase of each character.
        since: `(N,)` control steps since a motion was lost, or since a recovery motion began.
        vain: `(N,)` how many recovery motions in a row were lost.

    Args:
        hurries: a character that does not lie needs no rest at any time; without, only one that has just
            lost its recovery motion.
    """

    def __init__(self, count: int, rate_hz: float, device: torch.device | str, hurries: bool = False):
        self.doing = torch.zeros(count, dtype=torch.long, device=device)
        self.since, self.vain = torch.zeros_like(self.doing), torch.zeros_like(self.doing)
        self._waits, self._hurries = WAITS_S * rate_hz, hurries

    def watch(self, off: Tensor, speed: Tensor, lies: Tensor, ends: Tensor) -> PhaseChange:
        """One control step.

        Args:
            off: `(N,)` bool, characters too far from what they follow.
            speed: `(N,)` m/s of their bodies on average.
            lies: `(N,)` bool, characters that must get up.
            ends: `(N,)` bool, recovery motions at their end.
        """
        falls, returns = self.doing == FALLS, self.doing == RETURNS
        lost, back = off & ~falls, returns & ~off & ends
        self.vain += (returns & off).long()
        self.vain[back] = 0
        self.doing[back], self.doing[lost] = TRACKS, FALLS
        self.since[lost] = 0
        self.since += 1
        rests = falls & ((speed < REST) | (self.since > self._waits))
        upright = lost | falls if self._hurries else lost & returns
        return PhaseChange(lost, rests | (upright & ~lies), back)

    def fall(self, ids: Tensor) -> None:
        """Goals of characters `ids (n,)` wait from now on."""
        self.doing[ids], self.since[ids] = FALLS, 0

    def return_by(self, ids: Tensor) -> None:
        """Recovery motions of characters `ids (n,)` begin."""
        self.doing[ids], self.since[ids] = RETURNS, 0

    def begin(self, ids: Tensor) -> None:
        """Characters `ids (n,)` stand on their goals."""
        self.doing[ids], self.since[ids], self.vain[ids] = TRACKS, 0, 0


class Recovering(Goal):
    """Worlds follow another goal, and recovery motions back to it where they have lost it.

    That goal waits for a character that has lost it (`metrics.has_lost`). Once the character has come to
    rest it follows a recovery motion: to a frame of its clip in which it hardly moves and nearly stands,
    and goes on from there; or, where a generator makes the motion, to standing at ease, which the
    generator then sees as its past. To ask a generator to rest as the character lies, and to take
    another get-up clip after a try in vain, is worse: of 40 characters that were thrown over 32 were up
    after 12 s so, 37 without the other clips, 39 by this. A character that loses the recovery motion
    gets another one.

    Args:
        goal: clips or a generator.
        recovery_clips: of the library that the policy has learned; None: a character stays where it
            fell.
        chained: worlds do all clips from theirs on, in order: a recovery motion leads from the end of
            each to the first frame of the next, wherever that stands, unless the character is there.
        returns: whether a clip that is lost is come back to; without, it goes on to its end.
        plans: whether recovery motions are planned here; a copy of such a world, in which a controller
            tries something for some steps, does without.
        seats: where worlds that follow a generator sit down now and then; their planned motion is one
            like a recovery motion.

    Attributes:
        doing: `(N,)`, `TRACKS`, `FALLS` or `RETURNS`.
        steps: `(N,)` control steps that were made.
        lost: (world, control step) of every time a goal was lost.
        back: (world, control step) of every time one was come back to.
        aimed: coordinates `(N, 7 + n)` that the last step acted toward.
    """

    watches = True

    def __init__(
        self,
        goal: ClipGoal | GeneratorGoal,
        recovery_clips: RecoveryClips | None,
        chained: bool = False,
        returns: bool = True,
        plans: bool = True,
        seats: Seats | None = None,
    ):
        self.seats = seats if plans else None
        self.goal, self.chained, self.returns, self.plans = goal, chained, returns, plans
        self.humanoid, self.bodies, self.rate_hz = goal.humanoid, goal.bodies, goal.rate_hz
        self.layout, self.local = goal.layout, goal.local
        self.num_envs, self.device = goal.num_envs, goal.device
        self.rng, self.notes, self.begins = goal.rng, goal.notes, goal.begins
        self.get_up = None
        if recovery_clips is not None:
            self.get_up = GetUpPlanner(recovery_clips, self.humanoid.table, self.rate_hz)
            # From the end of a clip to the next one there is no hurry.
            self._calm = self.get_up.walks_calmly()
        self.lost, self.back = list[tuple[int, int]](), list[tuple[int, int]]()
        self._phases = RecoveryPhases(self.num_envs, self.rate_hz, self.device)
        self.doing, self._every = self._phases.doing, torch.arange(self.num_envs, device=self.device)
        self.steps = torch.zeros_like(self.doing)
        # Recovery motions lie one after another in a table that grows; which of it each world follows,
        # if it does, and the frame of that. A motion is over `_tail` frames before its last.
        self._on, self.at = torch.zeros_like(self.doing, dtype=torch.bool), torch.zeros_like(self.doing)
        self._first, self._length = torch.zeros_like(self.doing), torch.ones_like(self.doing)
        self._qpos = goal.start(self._every[:0])[0]
        self._packed = torch.zeros(0, self.layout.width, device=self.device)
        self._tail = goal.generator.past if isinstance(goal, GeneratorGoal) else 1
        self.aimed = self._qpos

    @property
    def clips(self) -> ClipGoal:
        return self.goal.clips

    @property
    def endless(self) -> GeneratorGoal:
        """The generator's motion that is come back to; there is one where clips are not followed."""
        assert isinstance(self.goal, GeneratorGoal)
        return self.goal

    @property
    def reached(self) -> list[tuple[int, int]]:
        """See `GeneratorGoal.reached`."""
        return self.goal.reached if isinstance(self.goal, GeneratorGoal) else []

    def strayed(self, rate_hz: float) -> tuple[tuple[float, float, float, float], ...]:
        """Of each world that came to the path of its generator: s on it, the share of them more than
        `REACHED` m from it, the mean and the greatest distance, m."""
        if not isinstance(self.goal, GeneratorGoal):
            return ()
        return tuple(
            (n / rate_hz, far / n, off / n, most)
            for n, far, off, most in self.goal.strayed.tolist()
            if n
        )

    # --- episodes -----------------------------------------------------------------------------

    def reset(self, ids: Tensor | None, clip: Tensor | None = None, frame: Tensor | None = None) -> None:
        self.goal.reset(ids, clip, frame)
        ids = self._every if ids is None else ids
        self._phases.begin(ids)
        self._on[ids] = False

    def start(self, ids: Tensor | None = None, later: int = 0) -> Start:
        qpos, qvel = self.goal.start(ids, later)
        rows, which = self._rows(ids, later)
        if len(rows):
            qpos[rows], qvel[rows] = self._qpos[which], 0.0
        return qpos, qvel

    def aim(self, ids: Tensor | None, held: Tensor | None) -> None:
        self._wait()
        self.goal.aim(ids, held)

    # --- frames -------------------------------------------------------------------------------

    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        return self._told(self.goal.ahead(k, ids), ids, k)

    def window(self, steps: tuple[int, ...], ids: Tensor | None = None) -> Tensor:
        told = self.goal.window(steps, ids)
        return torch.stack(
            [self._told(x, ids, k) for x, k in zip(told.unbind(1), steps, strict=True)], 1
        )

    def _told(self, packed: Tensor, ids: Tensor | None, k: int) -> Tensor:
        """The goal k steps later, and the recovery motions where worlds are on them."""
        rows, which = self._rows(ids, k)
        return packed.index_copy(0, rows, self._packed[which]) if len(rows) else packed

    def _rows(self, ids: Tensor | None, k: int) -> tuple[Tensor, Tensor]:
        """Rows of worlds `ids` that are on recovery motions, and where in the table they are in k
        steps."""
        rows = (self._on if ids is None else self._on[ids]).nonzero().squeeze(-1)
        of = rows if ids is None else ids[rows]
        return rows, self._first[of] + torch.minimum(self.at[of] + k, self._length[of] - 1)

    def targets(self) -> tuple[Tensor, Tensor]:
        table, of = self.goal.targets()
        rows, which = self._rows(None, 1)
        if not len(rows):
            return table, of
        hinges = table[of]
        hinges[rows] = self._qpos[which][:, 7:]
        return hinges, self._every

    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        now = self.ahead()
        self.aimed = self.start(None, 1)[0]
        self.goal.advance(
            self.doing != TRACKS if waited is None else waited | (self.doing != TRACKS), held
        )
        # A motion waits for a character that falls.
        self.at += (self.doing == RETURNS).long()
        self.steps += 1
        return now, self.ahead()

    # --- falls --------------------------------------------------------------------------------

    def watch(self, qpos: Tensor, pos: Tensor, linvel: Tensor) -> bool:
        """Notes worlds that have lost their goals, and leads those that have come to rest back and those
        that have done their clips on."""
        if self.plans:
            self.goal.watch(qpos, pos, linvel)
        off, speed = self._off(pos), linvel.norm(dim=-1).mean(-1)
        tracked = self.doing == TRACKS
        lies = off if self.get_up is None else self.get_up.lies(qpos)
        ends = self.at >= self._length - self._tail
        change = self._phases.watch(off & (~tracked | self.returns), speed, lies, ends)
        lost, back = change.lost, change.back
        sits = self._sits()
        if self.plans:
            self.lost += self._noted(lost & (tracked | sits))
            self.back += self._noted(back & ~sits)
        self._on[back] = False
        if isinstance(self.goal, GeneratorGoal) and bool(back.any()):
            ids = back.nonzero().squeeze(-1)
            stands = self._qpos[self._first[ids] + self._length[ids] - 1]
            self.goal.begin_from(ids, stands.unsqueeze(1).expand(-1, self._tail, -1))
        over = rests = change.rests & (self.plans and self.get_up is not None)
        if self.seats is not None and isinstance(self.goal, GeneratorGoal):
            rests = rests | self._visit(self.seats, self.goal, lost & sits, back & sits, qpos)
        if self.chained:
            over, away = self._next_clips(tracked & ~lost, pos)
            self._phases.fall(over & off & away)
            rests = rests | (over & ~off & away)
        if bool(rests.any()):
            # Between two clips nothing waits.
            self.lead(rests.nonzero().squeeze(-1), qpos, linvel[:, 0], self.doing == TRACKS)
        return bool((rests | back | (self.doing == FALLS) | over).any())

    def _sits(self) -> Tensor:
        """`(N,)` bool, worlds on a planned motion that sits down."""
        if self.seats is None:
            return torch.zeros_like(self._on)
        found = [self.seats.sits(i) for i in range(self.num_envs)]
        return torch.tensor(found, device=self.device)

    def _visit(
        self, seats: Seats, goal: GeneratorGoal, lost: Tensor, back: Tensor, qpos: Tensor
    ) -> Tensor:
        """Ends visits that are lost or over, leads free worlds to seats; `(N,)` bool, those that are to
        sit down now."""
        due = torch.zeros_like(lost)
        for i, q in enumerate(qpos.double().cpu().numpy()):
            step = int(self.steps[i])
            seats.watch(i, q)
            if bool(lost[i] | back[i]):
                seats.over(i, step, bool(back[i]))
            to = None
            # Targets and paths come first.
            if int(self.doing[i]) == TRACKS and goal.is_free(i):
                to = seats.leads(i, step, q[:2])
            if to is None:
                goal.led.pop(i, None)
            else:
                goal.led[i] = torch.from_numpy(to)
                due[i] = seats.due(i, q[:2])
        return due

    def _off(self, pos: Tensor) -> Tensor:
        return has_lost(pos, self.layout.unpacked(self.now()).pos)

    def _noted(self, worlds: Tensor) -> list[tuple[int, int]]:
        return [(i, int(self.steps[i])) for i in worlds.nonzero().squeeze(-1).tolist()]

    def _wait(self) -> None:
        """A generator makes nothing for characters that are not on its motion."""
        if isinstance(self.goal, GeneratorGoal):
            self.goal.waits.copy_(self.doing != TRACKS)

    def _next_clips(self, tracked: Tensor, pos: Tensor) -> tuple[Tensor, Tensor]:
        """Lets worlds that have done their clips go on with the next ones: which these are, and which
        characters are not at hand there, `(N,)` bool."""
        clips, own = self.clips, self.clips.reference
        more = clips.clip < len(own.length) - 1
        over = tracked & (clips.frame >= own.length[clips.clip] - 1) & more & self.plans
        clips.clip[over] += 1
        clips.frame[over] = 0
        apart = (pos - self.layout.unpacked(self.now()).pos).norm(dim=-1).mean(-1)
        return over, apart > AT_HAND

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
            frames = self._motion(i, calm is not None and bool(calm[i]), qpos[i].double().cpu(), moves)
            found, packed = self._posed(frames)
            self._first[i], self._length[i] = len(self._packed), len(packed)
            # The old table stays what it is in snapshots.
            self._packed, self._qpos = torch.cat((self._packed, packed)), torch.cat((self._qpos, found))
        self._on[worlds], self.at[worlds] = True, 0
        self._phases.return_by(worlds)

    def leave(self, worlds: Tensor) -> None:
        """Worlds `(n,)` leave their clips, and are led to the first frames of the next ones."""
        self.clips.clip[worlds] += 1
        self.clips.frame[worlds] = 0
        self._on[worlds] = False
        self._phases.fall(worlds)
        self.goal.aim(worlds, None)

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

    def _motion(self, world: int, calm: bool, qpos: Tensor, moves: Tensor | None) -> Tensor:
        """From `qpos (7 + n)` that moves with `moves (2)` m/s to where the world's goal is entered."""
        assert self.get_up is not None
        get_up, again = self._calm if calm else self.get_up, int(self._phases.vain[world])
        if isinstance(self.goal, GeneratorGoal):
            # At its end the character stands as long as the generator's past is.
            if self.seats is not None and int(self.doing[world]) == TRACKS:
                way = self.seats.motion(world, int(self.steps[world]), qpos, moves)
            else:
                way = way_to_stand(get_up, qpos, again=again)
            return torch.cat((way, way[-1:].expand(self._tail, -1)))
        goal, own, one = self.goal, self.goal.reference, slice(world, world + 1)
        if goal.frame[world] or not self.chained:
            goal.frame[world] = entry(get_up, own, int(goal.clip[world]), int(goal.frame[world]), qpos)
        place, velocity = (x[0].cpu() for x in own.coordinates(goal.clip[one], goal.frame[one]))
        return way_into(get_up, qpos, place, velocity, moves, again)

    def _posed(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Coordinates and packed poses of a recovery motion, as the goal has those of its own."""
        if isinstance(self.goal, GeneratorGoal):
            return self.goal.posed(frames.to(self._qpos))
        found = Reference(self.humanoid, [frames.numpy()], self.rate_hz, ["recovery"]).to(self.device)
        return found.qpos, found.packed(torch.arange(found.frames, device=self.device))

    def where(self, env: int) -> str:
        kind = {TRACKS: "", FALLS: ", lost", RETURNS: ", on its recovery motion"}[int(self.doing[env])]
        return f"{self.goal.where(env)}{kind}"

    # --- persistence --------------------------------------------------------------------------

    def rows(self) -> dict[str, Tensor]:
        own = {"doing": self.doing, "since": self._phases.since, "vain": self._phases.vain}
        table = {"on": self._on, "recovery_at": self.at, "first": self._first, "length": self._length}
        return {**self.goal.rows(), **own, **table, "recovery_steps": self.steps}

    def shared(self) -> dict[str, Tensor]:
        return {"packed": self._packed, "qpos": self._qpos}

    def load_shared(self, shared: Mapping[str, Tensor]) -> None:
        self._packed, self._qpos = shared["packed"], shared["qpos"]

    def state(self) -> dict[str, Tensor]:
        table = {f"recovery {name}": value for name, value in self.shared().items()}
        return {**self.goal.state(), **super().state(), **table}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.goal.load_state(state)
        super().load_state(state)
        self.load_shared({name: state[f"recovery {name}"].clone() for name in self.shared()})
