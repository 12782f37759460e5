"""Compliance in an environment: what pushes characters displaces their goals, at the physics rate."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from poise.control.compliance import (
    LEVEL,
    STIFFNESS,
    Compliance,
    Stiffness,
    columns,
    compliant_rate,
    moving,
    printed_velocity,
    room,
    settled,
    softening,
)
from poise.env.events import EpisodeStart, Event, Felt, Force
from poise.env.frame import Observable
from poise.env.goal import ClipGoal, Goal
from poise.env.reference import Poser, Start
from poise.errors import PoiseError
from poise.motion.rotations import quat_conj, quat_rotate
from poise.sim import Backend, CharacterRows, Drive, Mechanics, displaced


class DisplacedGoal(Goal):
    """Another goal, moved by `offset (N, 6 + n)`: m and rad of the root, rad of the hinges, in the
    coordinates of velocities (`sim.displaced`). Whatever yields to forces writes the offset, and `rate`
    `(N, 6 + n)`, its velocity, which is added to the goal's.

    hindsight: what is asked for now, by which rewards and ends are judged, stays where it is; what comes
    next, which policies see and actions add to, is displaced (`Stiffness.hindsight`).
    """

    def __init__(self, goal: Goal, hindsight: bool = False):
        self.num_envs, self.device, self._hindsight = goal.num_envs, goal.device, hindsight
        self.follow(goal)
        nv = self.humanoid.model.nv
        self.offset = torch.zeros(self.num_envs, nv, dtype=torch.float64, device=self.device)
        self.rate = torch.zeros_like(self.offset)
        self._poser = Poser(self.humanoid)
        self._every = torch.arange(self.num_envs, device=self.device)

    def follow(self, goal: Goal) -> None:
        """Displaces another goal of the same body from now on."""
        self.goal, self.begins, self.watches = goal, goal.begins, goal.watches
        self.humanoid, self.bodies, self.rate_hz = goal.humanoid, goal.bodies, goal.rate_hz
        self.layout, self.local, self.rng, self.notes = goal.layout, goal.local, goal.rng, goal.notes

    @property
    def clips(self) -> ClipGoal:
        return self.goal.clips

    def reset(self, ids: Tensor | None, clip: Tensor | None = None, frame: Tensor | None = None) -> None:
        self.goal.reset(ids, clip, frame)
        rows = slice(None) if ids is None else ids
        self.offset[rows], self.rate[rows] = 0.0, 0.0

    def start(self, ids: Tensor | None = None, later: int = 0) -> Start:
        qpos, qvel = self.goal.start(ids, later)
        rows = self._every if ids is None else ids
        return displaced(qpos, self.offset[rows]), qvel + self.rate[rows]

    def aim(self, ids: Tensor | None, held: Tensor | None) -> None:
        self.goal.aim(ids, held)

    def ahead(self, k: int = 1, ids: Tensor | None = None) -> Tensor:
        packed = self.goal.ahead(k, ids)
        return packed if self._hindsight and not k else self._moved(packed, ids)

    def window(self, steps: tuple[int, ...], ids: Tensor | None = None) -> Tensor:
        return self._moved_all(self.goal.window(steps, ids), ids)

    def targets(self) -> tuple[Tensor, Tensor]:
        table, rows = self.goal.targets()
        return table[rows] + self.offset[:, 6:], self._every

    def advance(self, waited: Tensor | None, held: Tensor | None) -> tuple[Tensor, Tensor]:
        now, ahead = self.goal.advance(waited, held)
        if self._hindsight:
            return now, self._moved(ahead, None)
        now, ahead = self._moved_all(torch.stack((now, ahead), 1), None).unbind(1)
        return now, ahead

    def watch(self, qpos: Tensor, pos: Tensor, linvel: Tensor) -> bool:
        return self.goal.watch(qpos, pos, linvel)

    def where(self, env: int) -> str:
        return self.goal.where(env)

    def state(self) -> dict[str, Tensor]:
        own = {"goal/offset": self.offset.clone(), "goal/offset_rate": self.rate.clone()}
        return {**self.goal.state(), **own}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.goal.load_state(state)
        self.offset.copy_(state["goal/offset"])
        self.rate.copy_(state["goal/offset_rate"])

    def rows(self) -> dict[str, Tensor]:
        return {**self.goal.rows(), "offset": self.offset, "offset_rate": self.rate}

    def _moved(self, packed: Tensor, ids: Tensor | None) -> Tensor:
        """Packed poses `(n, W)` by the offsets of worlds `ids`; those without any stay as they are."""
        return self._moved_all(packed.unsqueeze(1), ids).squeeze(1)

    def _moved_all(self, packed: Tensor, ids: Tensor | None) -> Tensor:
        """The same of K poses of each world `(n, K, W)`."""
        offset, rate = (x if ids is None else x[ids] for x in (self.offset, self.rate))
        off = ((offset != 0) | (rate != 0)).any(-1)
        if not bool(off.any()):
            return packed
        whole, k = bool(off.all()), packed.shape[1]
        moved, offset, rate = (x if whole else x[off] for x in (packed, offset, rate))
        rows = moved.flatten(0, 1)
        pose, place = self.layout.unpacked(rows), rows[:, -len(self.layout.place(rows)) :]
        many = (x.repeat_interleave(k, 0) for x in (offset, rate))
        qpos = displaced(pose.qpos.double(), next(many)).cpu()
        qvel = (pose.qvel.double() + next(many)).cpu()
        made = self.layout.pack(self._poser.live(qpos, qvel), place.cpu()).to(packed).view_as(moved)
        if whole:
            return made
        out = packed.clone()
        out[off] = made
        return out


#: Forces on one character that count, the strongest ones.
MOST = 4
#: m, rad and their rates below which u is 0.
LEAST = 1e-9


class Yielding(Event):
    """Displaces the goals of N characters where something pushes them (`TaskConfig.compliance`).

    Before each physics step the forces that other events tell (`Force.felt`) move
    `DisplacedGoal.offset`, u. A policy sees the displaced goal; where actions add to the goal's joint
    angles, what u has moved since the control step began is added to the targets, too. Where nothing
    acts u goes back to 0.

    Attributes:
        given: the law.
        goal: the displaced goal.
        level: `(N,)` float64, the dial: the level of compliance, or N/m of a commanded stiffness; may be
            changed at any time by `turn`.
        share: `(N,)` of the last physics step's displacement that the hinges' ranges let through.
        within: whether u keeps the goal's hinges in their ranges (Sec. 5.2 of the paper); a measurement
            of what they would do turns it off.
        outside: `(N,)` bool, where nothing keeps them, whether the last u took one out of its range.
    """

    def __init__(
        self,
        given: Compliance | Stiffness,
        goal: DisplacedGoal,
        backend: Backend,
        additive: bool,
        others: Sequence[Event],
    ):
        self.given, self.goal, self._backend, self._additive = given, goal, backend, additive
        table, here = goal.humanoid.table, backend.device
        self._weights = columns(table, given.weights, given.root).to(here)
        self._shares = torch.ones_like(self._weights)
        self._felt = [event for event in others if isinstance(event, Force)]
        self._mechanics = Mechanics(backend, inertia=False)
        if isinstance(given, Compliance):
            # The root has no share of its own.
            self._shares[6:] = columns(table, given.joints, True)[6:].to(here)
            shared = isinstance(backend, CharacterRows) and not backend.sole
            if given.law == "algorithm1" and shared:
                raise PoiseError(
                    "algorithm1 tries physics steps and takes them back, which worlds of several "
                    "characters do not",
                    "Compliance",
                    "Take law='eq8'",
                    code="settings-conflict",
                )
        model = backend.model
        ranges = np.where(model.jnt_limited[1:, None] == 1, model.jnt_range[1:], [-np.inf, np.inf])
        self._low, self._high = torch.from_numpy(ranges).to(here).unbind(1)
        self._kp = torch.from_numpy(model.actuator_gainprm[:, 0].copy()).to(here)
        self._step_s = float(model.opt.timestep)
        self._substeps = round(1.0 / (goal.rate_hz * self._step_s))
        n = backend.num_envs
        dial = given.level if isinstance(given, Compliance) else given.newtons_per_metre
        self.level = torch.full((n,), dial, dtype=torch.float64, device=here)
        self.share, self.within = torch.ones_like(self.level), True
        self.outside = torch.zeros_like(self.level, dtype=torch.bool)
        scheduled = given.schedule if isinstance(given, Stiffness) else ()
        self._schedule = torch.tensor([k for k, _ in scheduled], device=here)
        self._levels = torch.tensor([dial, *(k for _, k in scheduled)]).to(self.level)
        self.step = torch.zeros(n, dtype=torch.long, device=here)
        self._before, self._k, self._looked = goal.offset.clone(), 0, False
        self._rows = torch.arange(n, device=here).unsqueeze(1)

    def turn(self, level: float | Tensor, rows: Tensor | None = None) -> None:
        """Turns the dial of worlds `rows (n,)`, all for None: a level, or N/m.

        Raises:
            PoiseError: a level outside of 0 to 1, or a stiffness that is not above 0.
        """
        compliant = isinstance(self.given, Compliance)
        allowed, name = (LEVEL, "level") if compliant else (STIFFNESS, "stiffness")
        for value in torch.as_tensor(level, dtype=torch.float64).aminmax():
            allowed.check(float(value), name)
        self.level[slice(None) if rows is None else rows] = level

    def tells(self) -> Mapping[str, Tensor | Observable]:
        """u and the dial, for terms of a policy that learns with them."""
        return {"compliance/u": self.goal.offset, "compliance/level": self.level}

    def begin(self, episodes: EpisodeStart) -> None:
        """Draws the levels of new episodes, where they are drawn; a schedule begins anew."""
        self.step[episodes.rows] = 0
        if isinstance(self.given, Compliance) and self.given.drawn is not None:
            rows = self._rows[:, 0] if episodes.ids is None else episodes.ids
            low, high = self.given.drawn
            drawn = torch.rand(len(rows), generator=episodes.rng, dtype=torch.float64)
            self.level[rows] = low + (high - low) * drawn.to(self.level.device)

    def rows(self) -> dict[str, Tensor]:
        own = {"compliance/level": self.level}
        return {**own, "compliance/step": self.step} if len(self._schedule) else own

    def after_step(self) -> None:
        """Counts on, for a schedule."""
        self.step += 1

    def before_step(self, drive: Drive) -> bool:
        """A control step begins; what is left of u is nothing once it is too small to be seen."""
        if len(self._schedule):
            passed = torch.searchsorted(self._schedule, self.step, right=True)
            self.level.copy_(self._levels[passed])
        u, rate = self.goal.offset, self.goal.rate
        gone = (u.abs().amax(1, True) < LEAST) & (rate.abs().amax(1, True) < LEAST)
        u.masked_fill_(gone, 0.0)
        rate.masked_fill_(gone, 0.0)
        self._before.copy_(self.goal.offset)
        self._k, self._looked = 0, False
        return self._busy()

    def _look(self) -> None:
        """What the goal is in this control step, once something moves u: it takes as long as a quarter
        of the physics."""
        if self._looked:
            return
        self._looked, inner = True, self.goal.goal
        self._reference = [inner.layout.unpacked(packed) for packed in (inner.now(), inner.ahead())]
        table, rows = inner.targets()
        hinges = table[rows].double()
        self._least = torch.minimum(self._low, hinges) - hinges
        self._most = torch.maximum(self._high, hinges) - hinges

    def _busy(self) -> bool:
        """Whether u may move: it is not 0, or a force acts or may come where the dial is not at 0."""
        if bool((self.goal.offset != 0.0).any() or (self.goal.rate != 0.0).any()):
            return True
        if isinstance(self.given, Compliance) and not bool((self.level > 0.0).any()):
            return False
        for event in self._felt:
            felt = event.felt()
            if felt is None:
                continue
            # What is no part of the drive, or is told anew at each physics step, may come in between.
            held = felt.driven and felt.steady
            if not held or bool((felt.force.norm(dim=-1) >= self.given.least_n).any()):
                return True
        return False

    def before_substep(self, drive: Drive) -> None:
        """Moves u over the physics step that comes, and the targets with it."""
        felt = [f for f in (p.felt() for p in self._felt) if f is not None]
        self._move(felt)
        self._k += 1
        if self._additive:
            drive.ctrl.add_((self.goal.offset - self._before)[:, 6:])

    def _move(self, felt: Sequence[Felt]) -> None:
        u, rate = self.goal.offset, self.goal.rate
        acts = [f.force.norm(dim=-1) >= self.given.least_n for f in felt]
        pushed = torch.stack([a.any(1) for a in acts]).any(0) if acts else None
        back_u, back_rate = u, rate
        if pushed is None or not bool(pushed.all()):
            if not bool((u != 0.0).any() or (rate != 0.0).any()) and (
                pushed is None or not bool(pushed.any())
            ):
                return
            back_u, back_rate = settled(u, rate, self.given.return_hz, self._step_s)
        self._look()
        if pushed is None or not bool(pushed.any()):
            u.copy_(back_u)
            rate.copy_(back_rate)
        else:
            moved, speed = self._pushed(felt, acts)
            on = pushed.unsqueeze(1)
            u.copy_(torch.where(on, moved, back_u))
            rate.copy_(torch.where(on, speed, back_rate))
        if self.within:
            # Where the goal has moved on, what it leaves to its hinges' ranges has changed.
            u[:, 6:] = torch.maximum(torch.minimum(u[:, 6:], self._most), self._least)
        else:
            self.outside = ((u[:, 6:] < self._least) | (u[:, 6:] > self._most)).any(1)

    def _pushed(self, felt: Sequence[Felt], acts: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """u and u' after a physics step in which forces act."""
        u, given, h = self.goal.offset, self.given, self._step_s
        body, point, force = (
            torch.cat([f.body for f in felt], 1),
            torch.cat([f.point for f in felt], 1).double(),
            torch.cat([f.force for f in felt], 1).double(),
        )
        on = torch.cat(list(acts), 1)
        algorithm = isinstance(given, Compliance) and given.law == "algorithm1"
        if algorithm:
            jacobian = self._mechanics.linear(body, point)
            driven = torch.tensor([f.driven for f in felt for _ in range(f.body.shape[1])])
            change = self._changes(jacobian, force, driven)
        else:
            if body.shape[1] > MOST:
                # The strongest ones are enough, and each has a Jacobian.
                pick = force.norm(dim=-1).topk(MOST, 1).indices
                body, on = body.gather(1, pick), on.gather(1, pick)
                wide = pick.unsqueeze(-1).expand(-1, -1, 3)
                point, force = point.gather(1, wide), force.gather(1, wide)
            jacobian, change = self._mechanics.linear(body, point), None
        if isinstance(given, Stiffness):
            series = given.series and not given.hindsight
            soft = softening(jacobian, force, self.level, self._kp, series)
            soft = -soft if given.hindsight else soft
            aim = moving(jacobian, force * (soft * on).unsqueeze(-1), self._weights).sum(1)
            self.share = self._room(aim[:, 6:], self._least, self._most)
            # u' = (u* - u) / lag, exactly.
            left = float(np.exp(-h / given.lag_s))
            moved = torch.lerp(aim * self.share.unsqueeze(1), u, left)
            return moved, (moved - u) / h
        if change is not None:
            velocity = printed_velocity(jacobian, change, h)
        else:
            velocity = self._against(body, point, jacobian)
        velocity = velocity * on.unsqueeze(-1)
        speed = compliant_rate(jacobian, velocity, self.level, self._weights, given, self._shares)
        left_low, left_high = self._least - u[:, 6:], self._most - u[:, 6:]
        self.share = self._room(h * speed[:, 6:], left_low, left_high)
        speed = speed * self.share.unsqueeze(1)
        return u + h * speed, speed

    def _room(self, step: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """`(N,)` the share of a displacement that the ranges let through."""
        return room(step, low, high) if self.within else torch.ones_like(step[:, 0])

    def _against(self, body: Tensor, point: Tensor, jacobian: Tensor) -> Tensor:
        """x' `(N, K, 3)`: how fast points of the characters move against those of their references."""
        state, rows = self._backend.state, self._rows
        turn = state.xquat[rows, body].double()
        local = quat_rotate(quat_conj(turn), point - state.xpos[rows, body].double())
        at, row = min(1.0, self._k / self._substeps), (body - 1).clamp_min(0)
        moves = torch.zeros_like(point)
        for pose, share in zip(self._reference, (1.0 - at, at), strict=True):
            if share > 0.0:
                quat, linear, spin = (
                    x[rows, row].double() for x in (pose.quat, pose.linvel, pose.angvel)
                )
                moves += share * (linear + torch.linalg.cross(spin, quat_rotate(quat, local)))
        own = (jacobian @ state.qvel.double()[:, None, :, None]).squeeze(-1)
        return own - moves

    def _changes(self, jacobian: Tensor, force: Tensor, driven: Tensor) -> Tensor:
        """`(N, K, nv)` by how much each force changes `qvel` in one physics step."""
        pushes = (jacobian.transpose(-1, -2) @ force.unsqueeze(-1)).squeeze(-1)
        out = torch.zeros_like(pushes)
        for k in range(pushes.shape[1]):
            # What is in the drive already is taken out; what is not is put in.
            sign = -1.0 if bool(driven[k]) else 1.0
            out[:, k] = sign * self._mechanics.step_map(sign * pushes[:, k]).double()
        return out
