"""A generator as a goal: motion without end that goes where it should."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.stream_goal import BufferedGoal
from poise.errors import PoiseError
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


class GeneratorGoal(BufferedGoal):
    """Worlds follow motions that a generator makes as they go, from its own frames (line 11 of
    Algorithm 1). Where it makes what is no motion, the world's goal comes to rest, and `notes` says so.

    Args:
        generator: the model. num_envs: worlds. seed: of all that it draws.
        lead: frames that are always known ahead, as many as a controller looks ahead.
        plans: off for a copy of such a goal, which reads what that has known ahead and makes more only
            where it comes to the end of it.
        steering: where characters go, chosen among several futures of the generator.
        pasts: `(N, p, 7 + n)` from which worlds begin; by default the generator's own.
        simulated: the generator sees what characters did, up to now, in place of its own frames (which
            Algorithm 1, line 11, has it see).

    Attributes:
        waits: `(N,)` bool, worlds for which nothing is made, see `env.recovery.recovering`.
        steps: `(N,)` control steps that were made.
        reached: (world, control step) of every target that was.
    """

    watches = True

    def __init__(
        self,
        generator: MotionGenerator,
        humanoid: Humanoid,
        rate_hz: float,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        seed: int = 0,
        lead: int = 0,
        plans: bool = True,
        steering: Steering | None = None,
        pasts: Tensor | None = None,
        simulated: bool = False,
    ):
        if generator.past < 1 or generator.future < 1:
            raise PoiseError(
                f"a generator sees and makes at least 1 frame, got past {generator.past} and future "
                f"{generator.future}",
                code="out-of-range",
            )
        size = generator.past + 2 * generator.future + lead + 2
        super().__init__(humanoid, rate_hz, num_envs, size, torch.device(device), seed)
        self.generator, self.lead = generator, lead if plans else 0
        self.steering, self.pasts, self.simulated = steering or Steering(), pasts, simulated
        # Frames of each segment that are done before more is made: the way to a target is thought over
        # after half of one.
        half = -(-generator.future // 2)
        self.keeps = half if self.steering.targets else generator.future
        self.waits = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self.steps = torch.zeros_like(self.at)
        self.reached, self._passed = list[tuple[int, int]](), torch.zeros_like(self.at)
        # What characters did in the last frames, the last one now; how many of them are known.
        self._did = self.qpos[:, : generator.past].clone()
        self._known = torch.zeros_like(self.at)

    # --- episodes -----------------------------------------------------------------------------

    def reset(self, ids: Tensor | None, clip: Tensor | None = None, frame: Tensor | None = None) -> None:
        """New motions in worlds `ids`."""
        ids = self._begun(ids, clip)
        g = self.generator
        frames = g.begin(len(ids), self.rng) if self.pasts is None else self.pasts[ids].clone()
        want = (len(ids), g.past, self.humanoid.model.nq)
        if frames.shape != want or not bool(frames.isfinite().all()):
            raise PoiseError(
                f"the generator begins with {tuple(frames.shape)} coordinates, which must be finite and "
                f"{want}",
                type(g).__name__,
                code="wrong-shape",
            )
        self.begin_from(ids, frames.to(self.qpos))
        self.at[ids] = g.past - 1

    def begin_from(self, ids: Tensor, frames: Tensor) -> None:
        """Worlds `ids (n,)` do `frames (n, past, 7 + n)`, and then what the generator makes of them."""
        self.clear(ids)
        self.extend(ids, frames)
        self.at[ids], self._known[ids] = 0, 0

    # --- frames -------------------------------------------------------------------------------

    def supply(self, ids: Tensor) -> None:
        g = self.generator
        begun = (self.count[ids] > 0) & ~self.waits[ids]
        known = self.count[ids] - self.lead
        short = ids[begun & (self.at[ids] + 1 >= known) & (self.at[ids] < self.last[ids])]
        if not len(short):
            return
        index = self.count[short].unsqueeze(1) - g.past + torch.arange(g.past, device=self.device)
        past = self.qpos[short.unsqueeze(1), index.clamp_min(0) % self.size]
        made = self._made(past, short).to(past)
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

    def _made(self, past: Tensor, ids: Tensor) -> Tensor:
        """`(n, future, 7 + n)` frames that follow `past (n, past, 7 + n)` in worlds `ids (n,)`; where
        there is somewhere to go, of several futures the best."""
        past = self._past(past, ids) if self.simulated else past
        propose = getattr(self.generator, "propose", None)
        if propose is None or not self.steering.chooses:
            return self.generator.generate(past, ids, self.rng)
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
        self.steps += 1
        return super().advance(waited, held)

    def watch(self, qpos: Tensor, pos: Tensor, linvel: Tensor) -> bool:
        """Keeps what characters do on their motion, and notes those that have reached their target."""
        if self.simulated:
            good = ~self.waits & qpos.isfinite().all(-1)
            self._did = torch.cat((self._did[:, 1:], qpos[:, None].to(self._did)), 1)
            self._known = torch.where(good, (self._known + 1).clamp_max(self._did.shape[1]), 0)
        for i in range(self.num_envs if self.steering.targets else 0):
            target = self.steering.target(int(self._passed[i]))
            if target is not None and float((qpos[i, :2].double().cpu() - target).norm()) <= REACHED:
                self._passed[i] += 1
                self.reached.append((i, int(self.steps[i])))
        return False

    def where(self, env: int) -> str:
        return f"endless motion, control step {int(self.steps[env])}"

    def rows(self) -> dict[str, Tensor]:
        own = {"passed": self._passed, "did": self._did, "known": self._known, "steps": self.steps}
        generator = {f"generator/{k}": v for k, v in self.generator.rows().items()}
        return {**super().rows(), **generator, **own}
