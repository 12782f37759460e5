"""A generator as a goal: motion without end that survives falls, and goes where it should."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.led import FALLS, REST, RETURNS, TRACKS, WAITS_S
from poise.env.recovery.clips import GetUpPlanner, RecoveryClips
from poise.env.recovery.planner import way_to_stand
from poise.env.stream import BufferedGoal
from poise.errors import PoiseError
from poise.metrics import has_lost
from poise.settings import Checked, Range


class MotionGenerator(Protocol):
    """A model of motion: the environment's view of a kinematic policy (RFC Sec. 5, Algorithm 1).

    past: frames that it sees. future: frames that it makes at once.
    """

    past: int
    future: int

    def begin(self, count: int, rng: torch.Generator) -> Tensor:
        """`(count, past, 7 + n)` frames from which motions begin."""
        ...

    def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        """`(n, future, 7 + n)` frames that follow `past (n, past, 7 + n)` in worlds `ids (n,)`."""
        ...

    def rows(self) -> Mapping[str, Tensor]:
        """What it remembers of each world, `(N, ...)` by name, which snapshots copy in place."""
        ...


class GeneratorGoal(BufferedGoal):
    """Worlds follow motions that a generator makes as they go, from its own frames (line 11 of
    Algorithm 1). Where it makes what is no motion, the world's goal comes to rest, and `notes` says so.

    Args:
        generator: the model. num_envs: worlds. seed: of all that it draws.
        lead: frames that are always known ahead, as many as a controller looks ahead.
    """

    def __init__(
        self,
        generator: MotionGenerator,
        humanoid: Humanoid,
        rate_hz: float,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        seed: int = 0,
        lead: int = 0,
    ):
        if generator.past < 1 or generator.future < 1:
            raise PoiseError(
                f"a generator sees and makes at least 1 frame, got past {generator.past} and future "
                f"{generator.future}",
                code="out-of-range",
            )
        size = generator.past + 2 * generator.future + lead + 2
        super().__init__(humanoid, rate_hz, num_envs, size, torch.device(device), seed)
        self.generator, self.lead = generator, lead
        # Frames of what it makes that are done before it makes more.
        self.keeps = generator.future

    def begin(self, ids: Tensor) -> Tensor:
        """`(n, past, 7 + n)` frames from which motions of worlds `ids (n,)` begin."""
        return self.generator.begin(len(ids), self.rng)

    def make(self, past: Tensor, ids: Tensor) -> Tensor:
        """`(n, future, 7 + n)` frames that follow `past (n, past, 7 + n)` in worlds `ids (n,)`."""
        return self.generator.generate(past, ids, self.rng)

    def draw(self, ids: Tensor) -> None:
        """New motions in worlds `ids`."""
        frames = self.begin(ids)
        want = (len(ids), self.generator.past, self.humanoid.model.nq)
        if frames.shape != want or not bool(frames.isfinite().all()):
            raise PoiseError(
                f"the generator begins with {tuple(frames.shape)} coordinates, which must be finite and "
                f"{want}",
                type(self.generator).__name__,
                code="wrong-shape",
            )
        self.clear(ids)
        self.extend(ids, frames.to(self.qpos))
        self.at[ids] = self.generator.past - 1

    def supply(self, ids: Tensor) -> None:
        g = self.generator
        begun = self.count[ids] > 0
        known = self.count[ids] - self.lead
        short = ids[begun & (self.at[ids] + 1 >= known) & (self.at[ids] < self.last[ids])]
        if not len(short):
            return
        index = self.count[short].unsqueeze(1) - g.past + torch.arange(g.past, device=self.device)
        past = self.qpos[short.unsqueeze(1), index.clamp_min(0) % self.size]
        made = self.make(past, short).to(past)
        if made.shape != (len(short), g.future, past.shape[-1]):
            raise PoiseError(
                f"the generator made {tuple(made.shape)} coordinates, and {len(short)} motions of "
                f"{g.future} frames have ({len(short)}, {g.future}, {past.shape[-1]})",
                type(g).__name__,
                code="wrong-shape",
            )
        good = made.isfinite().all(-1).all(-1)
        for i in short[~good].tolist():
            self.last[i] = self.count[i] - 1
            self.notes.append(
                f"The generator made what is no motion in world {i} after frame {int(self.last[i])}; "
                "the character is to stand still there."
            )
        kept = short[good]
        if len(kept):
            self.extend(kept, made[good, : self.keeps])

    def rows(self) -> dict[str, Tensor]:
        own = {f"generator/{k}": v for k, v in self.generator.rows().items()}
        return {**super().rows(), **own}


#: Distance (m) at which a target is reached.
REACHED = 0.5
#: Most distance (m) of a target from the one before it.
FAR = 10_000.0
#: Distance (m) that characters are to keep, with what a simulation is off; cost of a metre too near.
APART, NEAR_COST = 0.7, 100.0
#: Futures that are proposed where one is chosen: to get somewhere, and to keep apart alone.
PROPOSALS, FEW = 240, 24


@dataclass(frozen=True)
class Steering(Checked):
    """Targets one after another, and distance from each other.

    Attributes:
        targets: x and y in m, in the order in which they are to be reached; after the last one
            characters go where they like.
        apart: whether characters of one world keep away from each other.
    """

    targets: Annotated[tuple[tuple[float, float], ...], Range(-FAR, FAR, unit="m")] = ()
    apart: bool = False

    @property
    def chooses(self) -> bool:
        """Whether one of several futures is to be chosen at all."""
        return bool(self.targets) or self.apart

    @property
    def proposals(self) -> int:
        """How many futures one is chosen from."""
        return PROPOSALS if self.targets else FEW

    def target(self, reached: int) -> Tensor | None:
        """The next one `(2)` m after so many; None after the last."""
        return torch.tensor(self.targets[reached]).double() if reached < len(self.targets) else None


def cost_of(futures: Tensor, target: Tensor | None, others: Sequence[Tensor]) -> Tensor:
    """What futures cost, `(K)`.

    Args:
        futures: `(K, f, 2)` m, where the root goes in each.
        target: `(2)` m; None for none.
        others: `(f, 2)` m, where each of the other characters goes meanwhile.
    """
    cost = torch.zeros(len(futures)).to(futures)
    if target is not None:
        off = (futures - target).norm(dim=-1)
        # Halfway counts as well, so that it does not go round about.
        cost = torch.minimum(0.5 * (off[:, -1] + off[:, off.shape[1] // 2]), off.amin(-1) + REACHED)
    for other in others:
        near = (APART - (futures - other).norm(dim=-1)).clamp_min(0.0)
        cost = cost + NEAR_COST * near.square().mean(-1)
    return cost


class EndlessGoal(GeneratorGoal):
    """Worlds follow a generator. Its motion waits for a character that has lost it; once that has come
    to rest it follows a recovery motion to standing at ease, and the generator goes on from that as its
    past. To ask it to rest as it lies, and to take another get-up clip after a try in vain, is worse:
    of 40 characters that were thrown over 32 were up after 12 s so, 37 without the other clips, 39 by
    this.

    Args:
        recovery_clips: of the library that the policy has learned; None never comes back.
        plans: whether recovery motions are planned here; a copy of such a world, in which a controller
            tries something for some steps, does without.
        steering: where characters go, chosen among several futures of the generator.
        pasts: `(N, p, 7 + n)` from which worlds begin; by default the generator's own.
        simulated: the generator sees what characters did, up to now, in place of its own frames (which
            Algorithm 1, line 11, has it see).

    Attributes:
        doing: `(N,)`, `TRACKS`, `FALLS` or `RETURNS`.
        falls: (world, control step) of every time a motion was lost.
        back: (world, control step) of every time one was up again.
        reached: (world, control step) of every target that was.
    """

    def __init__(
        self,
        generator: MotionGenerator,
        humanoid: Humanoid,
        rate_hz: float,
        recovery_clips: RecoveryClips | None,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        seed: int = 0,
        lead: int = 0,
        plans: bool = True,
        steering: Steering | None = None,
        pasts: Tensor | None = None,
        simulated: bool = False,
    ):
        super().__init__(generator, humanoid, rate_hz, num_envs, device, seed, lead)
        self.plans, self.recovery_clips = plans, recovery_clips
        if not plans:
            # A copy reads what the world that it is of has known ahead, and makes nothing itself.
            self.lead = 0
        self.steering, self.pasts = steering or Steering(), pasts
        if self.steering.targets:
            # The way to a target is thought over after each half of a segment.
            self.keeps = -(-generator.future // 2)
        self.get_up = None
        if recovery_clips is not None:
            self.get_up = GetUpPlanner(recovery_clips, humanoid.table, rate_hz)
        self.doing, self._since = torch.zeros_like(self.at), torch.zeros_like(self.at)
        self.steps = torch.zeros_like(self.at)
        self.falls, self.back = list[tuple[int, int]](), list[tuple[int, int]]()
        self.reached, self._passed = list[tuple[int, int]](), torch.zeros_like(self.at)
        # Recovery motions lie in a table; what of it each world has yet to read.
        self._ways = self.qpos[0, :0].clone()
        self._next, self._end = torch.zeros_like(self.at), torch.zeros_like(self.at)
        # The frame with which a recovery motion ends.
        self._until = torch.zeros_like(self.at)
        # How many recovery motions in a row each world has lost.
        self._vain = torch.zeros_like(self.at)
        # What characters did in the last frames, the last one now; how many of them are known.
        self.simulated = simulated
        self._did = self.qpos[:, : generator.past].clone()
        self._known = torch.zeros_like(self.at)

    # --- frames -------------------------------------------------------------------------------

    def begin(self, ids: Tensor) -> Tensor:
        return super().begin(ids) if self.pasts is None else self.pasts[ids].clone()

    def draw(self, ids: Tensor) -> None:
        super().draw(ids)
        self.doing[ids], self._since[ids] = TRACKS, 0
        self._next[ids], self._end[ids] = 0, 0
        self._known[ids] = self._vain[ids] = 0

    def supply(self, ids: Tensor) -> None:
        """A recovery motion's frames first, then the generator's, which sees them as its past. Where
        a character falls nothing is made."""
        ids = ids[self.doing[ids] != FALLS]
        while True:
            known = self.count[ids] - self.lead
            short = (self.at[ids] + 1 >= known) & (self._next[ids] < self._end[ids])
            if not bool(short.any()):
                break
            for i in ids[short].tolist():
                first = int(self._next[i])
                last = min(first + self.generator.future, int(self._end[i]))
                one = torch.tensor([i], device=self.device)
                self.extend(one, self._ways[None, first:last])
                self._next[i] = last
        super().supply(ids)

    def make(self, past: Tensor, ids: Tensor) -> Tensor:
        """The next frames; where there is somewhere to go, of several futures the best."""
        past = self._past(past, ids) if self.simulated else past
        propose = getattr(self.generator, "propose", None)
        if propose is None or not self.steering.chooses:
            return super().make(past, ids)
        futures, out = propose(past, self.rng, self.steering.proposals, ids), list[Tensor]()
        steps = torch.arange(1, self.generator.future + 1, device=self.device)
        for world, made in zip(ids.tolist(), futures, strict=True):
            others = list[Tensor]()
            for other in range(self.num_envs if self.steering.apart else 0):
                if other != world:
                    # The same moments of the other's motion, as far as they are known.
                    ahead = int(self.count[world] - 1 - self.at[world])
                    index = (self.at[other] + ahead + steps).clamp_max(int(self.count[other]) - 1)
                    others.append(self.qpos[other, index % self.size, :2])
            target = self.steering.target(int(self._passed[world]))
            out.append(made[int(cost_of(made[..., :2], target, others).argmin())])
        return torch.stack(out)

    def _past(self, past: Tensor, ids: Tensor) -> Tensor:
        """Pasts `(n, p, 7 + n)` in which what was done stands as far as it is known; frames that are yet
        to be done stay."""
        past, p = past.clone(), past.shape[1]
        for row, world in enumerate(ids.tolist()):
            coming = int(self.count[world] - 1 - self.at[world])
            done = min(p - coming, int(self._known[world]))
            if done > 0:
                past[row, p - coming - done : p - coming] = self._did[world, p - done :]
        return past

    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        # A motion waits for a character that falls.
        falling = self.doing == FALLS
        self.steps += 1
        return super().advance(falling if waited is None else waited | falling, held)

    # --- falls --------------------------------------------------------------------------------

    def watch(self, qpos: Tensor, pos: Tensor, linvel: Tensor) -> bool:
        """Notes worlds that have lost their motion, and leads those that have come to rest back."""
        self._arrive(qpos)
        self._see(qpos)
        falling, returning = self.doing == FALLS, self.doing == RETURNS
        ref = self.layout.unpacked(self.now()).pos
        off = has_lost(pos, ref)
        up = returning & ~off & (self.at >= self._until)
        for i in up.nonzero().squeeze(-1).tolist():
            self.back.append((i, int(self.steps[i])))
        self.doing[up], self._vain[up] = TRACKS, 0
        self._vain[off & returning] += 1
        lost = off & ~falling & ~up
        for i in (lost & ~returning).nonzero().squeeze(-1).tolist():
            if self.plans:
                self.falls.append((i, int(self.steps[i])))
        self.doing[lost], self._since[lost] = FALLS, 0
        self._since += 1
        if self.get_up is None:
            # It stays where it fell.
            return bool((falling | lost).any())
        late = self._since > WAITS_S * self.rate_hz
        rests = falling & ((linvel.norm(dim=-1).mean(-1) < REST) | late)
        # What has not fallen needs no rest.
        rests |= lost & returning & ~self.get_up.lies(qpos)
        rests &= torch.full_like(rests, self.plans)
        for i in rests.nonzero().squeeze(-1).tolist():
            self._lead(i, qpos[i].double().cpu())
        return bool((rests | falling | up).any())

    def _see(self, qpos: Tensor) -> None:
        """Keeps what characters do while they track their motion."""
        if not (self.simulated and self.plans):
            return
        good = (self.doing == TRACKS) & qpos.isfinite().all(-1)
        self._did = torch.cat((self._did[:, 1:], qpos[:, None].to(self._did)), 1)
        self._known = torch.where(good, (self._known + 1).clamp_max(self._did.shape[1]), 0)

    def _arrive(self, qpos: Tensor) -> None:
        """Notes characters that have reached their target."""
        if not self.plans or not self.steering.targets:
            return
        for i in range(self.num_envs):
            target = self.steering.target(int(self._passed[i]))
            if target is not None and float((qpos[i, :2].double().cpu() - target).norm()) <= REACHED:
                self._passed[i] += 1
                self.reached.append((i, int(self.steps[i])))

    def _lead(self, world: int, qpos: Tensor) -> None:
        """A recovery motion for a world from where its character is, at the end of which it stands as
        long as the generator's past is."""
        assert self.get_up is not None
        way = way_to_stand(self.get_up, qpos, again=int(self._vain[world]))
        way = torch.cat((way, way[-1:].expand(self.generator.past, -1))).to(self._ways)
        # The old table stays what it is in snapshots.
        used = self._next < self._end
        self._ways = torch.cat((self._ways if bool(used.any()) else self._ways[:0], way))
        one = torch.tensor([world], device=self.device)
        self._end[world] = len(self._ways)
        self._next[world] = len(self._ways) - len(way)
        self.clear(one)
        self.at[world], self._until[world] = 0, len(way) - self.generator.past
        self.doing[world] = RETURNS
        self.append(one, way[:1])
        self._next[world] += 1
        self.supply(one)
        self._stale[world] = True

    def where(self, env: int) -> str:
        kind = {TRACKS: "", FALLS: ", lost", RETURNS: ", getting up"}[int(self.doing[env])]
        return f"endless motion, control step {int(self.steps[env])}{kind}"

    # --- persistence --------------------------------------------------------------------------

    def rows(self) -> dict[str, Tensor]:
        own = {"doing": self.doing, "since": self._since, "steps": self.steps, "next": self._next,
               "end": self._end, "until": self._until, "passed": self._passed,
               "did": self._did, "known": self._known, "vain": self._vain}  # fmt: skip
        return {**super().rows(), **own}

    def state(self) -> dict[str, Tensor]:
        return {**super().state(), "goal ways": self._ways}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        super().load_state(state)
        self._ways = state["goal ways"].clone()

    def shared(self) -> dict[str, Tensor]:
        return {"ways": self._ways}

    def load_shared(self, shared: Mapping[str, Tensor]) -> None:
        self._ways = shared["ways"]
