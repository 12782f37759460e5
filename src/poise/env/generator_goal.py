"""A generator as a goal: motion without end that goes where it should."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.stream_goal import BufferedGoal
from poise.env.walk_path import FAR, WalkPath
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
#: Distance (m) that characters are to keep, with what a simulation is off and a fall takes; cost of a
#: metre too near; distance (m) within which others are in the way; s whose speed goes on unseen.
APART, NEAR_COST, IN_THE_WAY, GOES_S = 1.1, 100.0, 3.0, 0.3
#: m about a box that stands in the way in which no root is to be.
CLEAR = 0.35
#: Costs of a m from the path on average and at most, and of a m by which the way along it is too short.
OFF_COST, FARTHEST_COST, LATE_COST = 2.0, 1.0, 0.5
#: m/s at which a path is to be followed at least, where no speed is wished for; rad/s and m/s with which
#: what walks turns along it.
GOES_ON, BEND, WALKS = 1.1, 1.0, 0.8
#: Futures that are proposed where one is chosen: to get somewhere, on a path or where others are in the
#: way, and to keep apart alone.
PROPOSALS, SOME, FEW = 240, 96, 24


@dataclass(frozen=True)
class Footprint(Checked):
    """A box on the floor, seen from above, that characters walk round.

    Attributes:
        pos: m, its middle. size: m, its extents along its own axes. yaw: rad, its turn about Z.
    """

    pos: tuple[float, float]
    size: tuple[float, float]
    yaw: float = 0.0

    def seen(self, places: Tensor) -> Tensor:
        """Places `(..., 2)` m of the world in its own frame."""
        out, c, s = places - torch.tensor(self.pos).to(places), math.cos(self.yaw), math.sin(self.yaw)
        return torch.stack((c * out[..., 0] + s * out[..., 1], c * out[..., 1] - s * out[..., 0]), -1)

    def depth(self, places: Tensor, margin: float = 0.0) -> Tensor:
        """`(...)` m by which places `(..., 2)` lie in it, with a margin about it; 0 outside."""
        half = 0.5 * torch.tensor(self.size).to(places) + margin
        return (half - self.seen(places).abs()).amin(-1).clamp_min(0.0)


@dataclass(frozen=True)
class Steering(Checked):
    """Targets one after another or a path, and distance from each other and from what stands there.

    Attributes:
        targets: x and y in m, in the order in which they are to be reached; after the last one
            characters go where they like.
        apart: whether characters of one world keep away from each other.
        path: that is followed from its first point on, in place of targets; None for none.
        boxes: that are walked round.
        leads: whether worlds may be led somewhere else for a while, see `GeneratorGoal.led`.
    """

    targets: Annotated[tuple[tuple[float, float], ...], Range(-FAR, FAR, unit="m")] = ()
    apart: bool = False
    path: WalkPath | None = None
    boxes: tuple[Footprint, ...] = ()
    leads: bool = False

    @property
    def goes(self) -> bool:
        """Whether there is somewhere to go."""
        return bool(self.targets) or self.path is not None or self.leads

    @property
    def chooses(self) -> bool:
        """Whether one of several futures is to be chosen at all."""
        return self.goes or self.apart or bool(self.boxes)

    def target(self, reached: int) -> Tensor | None:
        """The next one `(2)` m after so many; None after the last."""
        return torch.tensor(self.targets[reached]).double() if reached < len(self.targets) else None


def cost_of(
    futures: Tensor,
    target: Tensor | None,
    others: Sequence[Tensor],
    boxes: Sequence[Footprint] = (),
) -> Tensor:
    """What futures cost, `(K)`.

    Args:
        futures: `(K, f, 2)` m, where the root goes in each.
        target: `(2)` m; None for none.
        others: `(f, 2)` m, where each of the other characters goes meanwhile.
        boxes: that stand in the way.
    """
    cost = torch.zeros(len(futures)).to(futures)
    if target is not None:
        off = (futures - target).norm(dim=-1)
        # Halfway counts as well, so that it does not go round about.
        cost = torch.minimum(0.5 * (off[:, -1] + off[:, off.shape[1] // 2]), off.amin(-1) + REACHED)
    for other in others:
        near = (APART - (futures - other).norm(dim=-1)).clamp_min(0.0).square()
        # The nearest moment counts by itself: who brushes by hits, too.
        cost = cost + NEAR_COST * (near.mean(-1) + 0.5 * near.amax(-1))
    for box in boxes:
        cost = cost + NEAR_COST * box.depth(futures, CLEAR).square().mean(-1)
    return cost


def path_cost(path: WalkPath, along: Tensor, off: Tensor, first: float, fps: float) -> Tensor:
    """The costs of futures that go along a path, `(K)`.

    Args:
        along, off: `(K, f)` m along it and from it, see `WalkPath.bent`. first: m, where they begin.
    """
    seconds = along.shape[1] / fps
    late = (path.speed or GOES_ON) * seconds - (along[:, -1] - first)
    late = late.clamp_min(0.0) if path.speed is None else late.abs()
    return OFF_COST * off.mean(1) + FARTHEST_COST * off.amax(1) + LATE_COST * late


@dataclass(frozen=True, eq=False)
class Futures:
    """Motions that may follow, in the order in which a generator or the way to be gone prefers them.

    Attributes:
        made: `(K, f, 7 + n)`. along: `(K, f)` m along the path; None where there is none.
    """

    made: Tensor
    along: Tensor | None = None

    def __len__(self) -> int:
        return len(self.made)


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
        led: x and y in m to which a world is led, before all targets, while it is told here.
        strayed: `(N, 4)` of worlds that have come to the path: control steps on it, those of them more
            than `REACHED` m from it, the sum and the most of their distances, m.
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
        self.keeps = half if self.steering.goes or self.steering.apart else generator.future
        self.waits = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self.steps = torch.zeros_like(self.at)
        self.reached, self._passed = list[tuple[int, int]](), torch.zeros_like(self.at)
        # Frames that were chosen for worlds before they are needed.
        self._chosen = dict[int, tuple[Tensor, Tensor | None]]()
        self.led = dict[int, Tensor]()
        self.strayed = torch.zeros(num_envs, 4, dtype=torch.float64, device=self.device)
        # m along the path of the roots, of the last frames that are known, and where the roots are.
        self._along = torch.zeros(num_envs, dtype=torch.float64, device=self.device)
        self._known_along = torch.zeros_like(self._along)
        self._done = torch.zeros_like(self.waits)
        self._root = torch.zeros(num_envs, 2, dtype=torch.float64, device=self.device)
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
        for world in ids.tolist():
            self._chosen.pop(world, None)
        self.extend(ids, frames)
        self.at[ids], self._known[ids] = 0, 0
        self._known_along[ids] = self._along[ids]

    # --- frames -------------------------------------------------------------------------------

    def supply(self, ids: Tensor) -> None:
        g = self.generator
        begun = (self.count[ids] > 0) & ~self.waits[ids]
        known = self.count[ids] - self.lead
        short = ids[begun & (self.at[ids] + 1 >= known) & (self.at[ids] < self.last[ids])]
        for i in short.tolist():
            if (chosen := self._chosen.pop(i, None)) is not None:
                frames, along = chosen
                self.extend(torch.tensor([i], device=self.device), frames[None])
                if along is not None:
                    self._known_along[i] = along
        short = short[self.at[short] + 1 >= self.count[short] - self.lead]
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
        if not (self._proposes and self.steering.chooses):
            return self.generator.generate(past, ids, self.rng)
        out = list[Tensor]()
        for row, world in enumerate(ids.tolist()):
            best = self._preferred(world, past[row : row + 1], 1, True)
            if best.along is not None:
                self._known_along[world] = best.along[0, self.keeps - 1]
            out.append(best.made[0])
        return torch.stack(out)

    @property
    def _proposes(self) -> bool:
        return getattr(self.generator, "propose", None) is not None

    def _preferred(self, world: int, past: Tensor, count: int, wished: bool) -> Futures:
        """The best of what may follow `past (1, past, 7 + n)`, at most so many."""
        propose = self.generator.propose  # type: ignore[attr-defined]
        ids = torch.tensor([world], device=self.device)
        if not self.steering.chooses:
            # Without a place to go, what is usual is as varied as the library.
            return Futures(propose(past, self.rng, count, ids if wished else None, count)[0])
        last, target = past[0, -1].double(), self._target(world)
        path, begun = self._path(world, last)
        goes = target is not None or path is not None
        others, boxes = self._others(world), self.steering.boxes
        crowded = any(float((o - last[:2]).norm(dim=-1).amin()) < IN_THE_WAY for o in others)
        many = PROPOSALS if target is not None else SOME if goes or crowded else FEW
        # A place to go counts alone, not what the world wishes.
        made = propose(past, self.rng, many, ids if wished and not goes else None)[0]
        cost = torch.zeros(len(made)).to(made)
        along = None
        if path is not None:
            made, along, off = path.bent(made, last, begun, self.rate_hz, BEND, WALKS)
            cost = path_cost(path, along, off, begun, self.rate_hz)
        cost = cost + cost_of(made[..., :2], target, others, boxes)
        best = cost.argsort(stable=True)[:count]
        return Futures(made[best], None if along is None else along[best])

    # --- what is tried before -----------------------------------------------------------------

    def due(self) -> list[int]:
        """Worlds for which more frames are made in the next step, unless they are chosen already."""
        ends = self.at + 2 >= self.count - self.lead
        short = (self.count > 0) & ~self.waits & ends & (self.at + 1 < self.last)
        return [i for i in short.nonzero().squeeze(-1).tolist() if i not in self._chosen]

    def forget(self, world: int) -> None:
        """Frames of a world that are yet to come are made anew."""
        self.count[world] = self.at[world] + 1
        self._known_along[world] = self._along[world]

    def futures(self, world: int, count: int, wished: bool = True) -> Futures:
        """Motions that may follow in a world, at most so many; a generator that proposes none has one.

        wished: as the world wishes, or whatever the generator makes.
        """
        p = self.generator.past
        index = self.count[world] - p + torch.arange(p, device=self.device)
        past = self.qpos[world, index.clamp_min(0) % self.size][None]
        ids = torch.tensor([world], device=self.device)
        past = self._past(past, ids) if self.simulated else past
        if not self._proposes:
            return Futures(self.generator.generate(past, ids, self.rng))
        return self._preferred(world, past, count, wished)

    def choose(self, world: int, futures: Futures, which: int, frames: int) -> None:
        """So many frames of one of some futures follow in a world; frames that are not finite are left
        out."""
        kept = futures.made[which, :frames]
        if bool(kept.isfinite().all()):
            along = None if futures.along is None else futures.along[which, len(kept) - 1]
            self._chosen[world] = kept.to(self.qpos), along

    def is_free(self, world: int) -> bool:
        """Whether a world has no target left and is on no path."""
        path = self.steering.path
        there = path is None or bool(self._done[world])
        return there and self.steering.target(int(self._passed[world])) is None

    def _target(self, world: int) -> Tensor | None:
        """The place that a world is to go to next, `(2)` m; None for no place in particular."""
        led = self.led.get(world)
        return self.steering.target(int(self._passed[world])) if led is None else led

    def _path(self, world: int, last: Tensor) -> tuple[WalkPath | None, float]:
        """The path that a world follows after its last frame `(7 + n)`, and how far along it that is,
        m."""
        path = self.steering.path
        if path is None or world in self.led:
            return None, 0.0
        begun = float(path.nearest(last[None, :2], self._known_along[world : world + 1])[0])
        return (None if path.over(begun) else path), begun

    def _others(self, world: int) -> list[Tensor]:
        """`(f, 2)` m, where each other character is in the frames that are made for a world."""
        steps = torch.arange(1, self.generator.future + 1, device=self.device)
        out = list[Tensor]()
        for other in range(self.num_envs if self.steering.apart else 0):
            if other == world:
                continue
            if self.waits[other]:
                # It lies, gets up or sits, wherever its motion would be.
                out.append(self._root[other].expand(len(steps), 2))
                continue
            # The same moments of the other's motion; beyond what is known it goes on as it goes.
            ahead = int(self.count[world] - 1 - self.at[world])
            index, last = self.at[other] + ahead + steps, int(self.count[other]) - 1
            before = max(0, last - round(GOES_S * self.rate_hz))
            goes = self.qpos[other, last % self.size, :2] - self.qpos[other, before % self.size, :2]
            beyond = (index - last).clamp_min(0) / max(1, last - before)
            known = self.qpos[other, index.clamp_max(last) % self.size, :2]
            out.append(known + beyond[:, None] * goes)
        return out

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
        self._root = qpos[:, :2].double().clone()
        if self.steering.path is not None:
            self._stray(self.steering.path)
        for i in range(self.num_envs if self.steering.targets else 0):
            target = self.steering.target(int(self._passed[i]))
            if target is not None and float((qpos[i, :2].double().cpu() - target).norm()) <= REACHED:
                self._passed[i] += 1
                self.reached.append((i, int(self.steps[i])))
        return False

    def _stray(self, path: WalkPath) -> None:
        """Notes how far along the path and how far from it characters are."""
        self._along, off = path.nearest(self._root.cpu(), self._along)
        self._done |= torch.tensor([path.over(float(s)) for s in self._along])
        come = ~self._done & ((self.strayed[:, 0] > 0) | (off <= REACHED))
        self.strayed[come, 0] += 1
        self.strayed[come, 1] += (off > REACHED).double()[come]
        self.strayed[come, 2] += off[come]
        self.strayed[come, 3] = torch.maximum(self.strayed[:, 3], off)[come]

    def where(self, env: int) -> str:
        return f"endless motion, control step {int(self.steps[env])}"

    def rows(self) -> dict[str, Tensor]:
        own = {
            "passed": self._passed,
            "did": self._did,
            "known": self._known,
            "steps": self.steps,
            "along": self._along,
            "known_along": self._known_along,
            "root": self._root,
        }
        generator = {f"generator/{k}": v for k, v in self.generator.rows().items()}
        return {**super().rows(), **generator, **own}
