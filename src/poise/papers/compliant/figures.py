"""Figures in the paper's terms: stiffness at the hands, and obstacles thrown (Sec. 5.2, Fig. 4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from poise.control import Compliance, Stiffness
from poise.env.events import Event, Felt, Force
from poise.env.scene_events import ScenePart
from poise.env.yielding import DisplacedGoal, Yielding
from poise.errors import PoiseError
from poise.jobs.tracker import Tracker
from poise.papers.compliant.motions import standing
from poise.papers.compliant.scene_training import LearnedOnTop, seen
from poise.papers.compliant.scenes import Throws
from poise.recipes.imitation import Imitation
from poise.sim import Backend, Drive, SimConfig

#: Directions that are pushed in, world axes.
AXES = (
    (1.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, -1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0),
)
#: s: the character stands, is pushed, and its hand is looked at in the last of it.
STANDS_S, PUSHED_S, SEEN_S = 2.0, 3.0, 1.0
#: N, with which hands are pushed at most: by 20 N some make a step, and what is measured is the step.
MOST_N = 10.0
#: Share of the pelvis' height below which the character has fallen.
FALLEN = 0.7


@dataclass(frozen=True)
class Measured:
    """One hand, pushed in one direction: how stiff a character that stands is there.

    A constant force acts along an axis, and x is how far the hand comes to rest from where it stands
    without the force; K = f / x along the force.

    Attributes:
        commanded: N/m, or the level of compliance; None without either.
        hand: the body.
        direction: of the force, world axes.
        newtons: of it.
        moved_m: along the force, against where the hand stands without it.
        fell: whether the character fell, so that nothing was measured.
    """

    commanded: float | None
    hand: str
    direction: tuple[float, float, float]
    newtons: float
    moved_m: float
    fell: bool

    @property
    def stiffness(self) -> float:
        """K, N/m; NaN where nothing was measured."""
        return float("nan") if self.fell or self.moved_m <= 0.0 else self.newtons / self.moved_m


class _Held(Force):
    """A constant force on one body of each character, while it is on."""

    def __init__(self, backend: Backend, body: Tensor, force: Tensor):
        self.backend, self.body, self.force, self.on = backend, body, force, False
        self._every = torch.arange(len(body))

    def before_step(self, drive: Drive) -> bool:
        """Adds the force."""
        if self.on:
            drive.xfrc_applied[self._every, self.body, :3] += self.force
        return False

    def felt(self) -> Felt:
        """The force, while it is on."""
        at = self.backend.state.xipos[self._every, self.body]
        return Felt(self.body[:, None], at[:, None], self.force[:, None] * float(self.on))


def measure(
    tracker: Tracker,
    given: Compliance | Stiffness | None,
    commands: Sequence[float] = (),
    newtons: Callable[[float], float] = lambda k: min(MOST_N, 0.05 * k),
    threads: int = 0,
) -> list[Measured]:
    """Every command at every hand in six directions, all at once, by the policy alone.

    Args:
        given: how the character gives way; its level or stiffness is what `commands` replace.
        commands: levels, or N/m; () measures the character as it is, once.
        newtons: the force for a command.

    Raises:
        PoiseError: the body has no hands.
    """
    task = standing(tracker, STANDS_S + PUSHED_S)
    hands = task.humanoid.rows_of("hand")
    if not hands:
        raise PoiseError(
            "the body has no hands, at which stiffness is measured", code="body-part-missing"
        )
    asked: list[float | None] = list(commands) or [None]
    # Each hand without a force as well, once for each command.
    rows = [
        (k, hand, axis, 0.0 if axis is None else newtons(0.0 if k is None else k))
        for k in asked
        for hand in hands
        for axis in (None, *AXES)
    ]
    body = torch.tensor([hand + 1 for _, hand, _, _ in rows])
    force = torch.tensor([[size * a for a in axis or (0.0,) * 3] for _, _, axis, size in rows]).double()
    held: list[_Held] = []

    def hold(goal: object, backend: Backend) -> Event:
        held.append(_Held(backend, body, force))
        return held[0]

    own = replace(task.task, events=(hold,), compliance=given, dones=(), help_by="all")
    env = replace(task, task=own).env(
        len(rows), auto_reset=False, threads=threads, help_scale=0.0, guard=False
    )
    yields = env.event(Yielding)
    if yields is not None:
        yields.turn(torch.tensor([k for k, *_ in rows], dtype=torch.float64))
    zero, every = torch.zeros(len(rows), dtype=torch.long), torch.arange(len(rows))
    obs, rate = env.reset_to(zero, zero), task.reference.rate_hz
    height = env.pose().pos[:, 0, 2].clone()
    fell, seen = torch.zeros(len(rows), dtype=torch.bool), list[Tensor]()
    steps = [round(s * rate) for s in (STANDS_S, PUSHED_S, SEEN_S)]
    for k in range(steps[0] + steps[1] - 1):
        held[0].on = k >= steps[0]
        obs = env.step(tracker.policy.act(obs)).final_obs
        fell |= env.pose().pos[:, 0, 2] < FALLEN * height
        if k >= steps[0] + steps[1] - 1 - steps[2]:
            seen.append(env.backend.state.xipos[every, body].clone())
    env.close()
    at = torch.stack(seen).mean(0)
    out, still = list[Measured](), 0
    for i, (command, hand, axis, size) in enumerate(rows):
        if axis is None:
            still = i
            continue
        moved = float((at[i] - at[still]) @ torch.tensor(axis).double())
        lost = bool(fell[i] or fell[still])
        out.append(Measured(command, task.humanoid.bodies[hand], axis, size, moved, lost))
    return out


#: s: it stands before the throw; contacts and torques count for so long from the first contact on; it
#: is looked at whether it falls up to the end.
WAITS_S, COUNTS_S, LASTS_S = 1.5, 0.5, 4.0
#: N; a weaker contact is none.
TOUCHES_N = 1.0


@dataclass(frozen=True, eq=False)
class Thrown:
    """What each of M throws did at each of A levels, `(A, M)`; NaN where the ball missed.

    Attributes:
        levels: of compliance, or N/m.
        impulse: N s, size of the sum of the contact forces over time.
        peak: N, the greatest contact force of a physics step.
        torque: N m, mean over the hinges and over 0.5 s of the size of what the servos exert.
        moved: m, how far the goal's pelvis and hinged bodies gave way at most, mean of the bodies.
        outside: share of the frames from the first contact on in which what gave way took a hinge of the
            goal out of its range.
        off: m, how far the bodies were from their goal before the first contact, mean of all.
        stood: N m, the torque before the first contact.
        fell: whether the character fell.
    """

    levels: tuple[float, ...]
    impulse: np.ndarray
    peak: np.ndarray
    torque: np.ndarray
    moved: np.ndarray
    outside: np.ndarray
    off: np.ndarray
    stood: np.ndarray
    fell: np.ndarray


def throws(
    tracker: Tracker,
    given: Compliance | Stiffness,
    levels: Sequence[float],
    count: int = 200,
    rate_hz: float | None = None,
    seed: int = 0,
    threads: int = 0,
    show: Callable[[int, int], None] | None = None,
    learned: LearnedOnTop | None = None,
    within: bool = True,
) -> Thrown:
    """The same throws at each level, by the policy alone (Deep Compliant Control, Sec. 5.2 and Fig. 4).

    A ball comes at 2 to 3 m/s from a random direction, once. Up to the first contact the worlds of all
    levels are the same to the last bit, unless what was learned sees the level.

    Args:
        given: how the character gives way; its level or stiffness is what `levels` replace.
        count: of throws.
        rate_hz: of the physics; None for the policy's own.
        show: is told how many levels of how many are done.
        learned: what was learned on top of the policy, which must have learned levels that are drawn.
        within: whether the goal's hinges stay in their ranges, see `Yielding`.

    Raises:
        PoiseError: a level outside of 0 to 1, or a policy that knows no pose at ease.
    """
    task = standing(tracker, LASTS_S)
    physics = task.config.sim
    if rate_hz is not None:
        physics = SimConfig(rate_hz=rate_hz, control_hz=physics.control_hz)
        task = replace(task, config=replace(task.config, sim=physics))
    stage = Throws(speed=(2.0, 3.0), every_s=(WAITS_S, WAITS_S), seed=seed).stage(
        task.humanoid, task.reference
    )
    own = replace(task.task, events=stage.events, compliance=given, dones=(), help_by="all")
    if learned is not None:
        learned.config.played(given)
        own = replace(own, obs=(*own.obs, *seen(stage, learned.config)))
    task = replace(task, task=own, props=stage.props, touches=stage.touches)
    found = list[tuple[np.ndarray, ...]]()
    for k, level in enumerate(levels):
        found.append(_at(tracker, task, count, threads, level, learned, within))
        if show is not None:
            show(k + 1, len(levels))
    columns = (np.stack(c) for c in zip(*found, strict=True))
    return Thrown(tuple(levels), *columns)


def _at(
    tracker: Tracker,
    task: Imitation,
    count: int,
    threads: int,
    level: float,
    learned: LearnedOnTop | None,
    within: bool,
) -> tuple[np.ndarray, ...]:
    """The rows `(M,)` of `Thrown` at one level."""
    env = task.env(count, None, False, threads, help_scale=0.0, guard=False)
    yields = env.event(Yielding)
    part, goal = env.event(ScenePart), env.goal
    assert yields is not None and part is not None and isinstance(goal, DisplacedGoal)
    throw, policy = part.events[1], tracker.policy if learned is None else learned.over(tracker, env)
    yields.turn(level)
    yields.within = within
    zero = torch.zeros(count, dtype=torch.long)
    obs, rate = env.reset_to(zero, zero), task.reference.rate_hz
    height = env.pose().pos[:, 0, 2].clone()
    impulse = torch.zeros(count, 3, dtype=torch.float64)
    peak, torque, counted, moved, out, after, off, stood, before = (
        torch.zeros(count, dtype=torch.float64) for _ in range(9)
    )
    left = torch.full((count,), round(COUNTS_S * rate))
    hit, fell = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
    # One throw: the next one would be due after the wait again.
    last = round(2.0 * WAITS_S * rate) - 1
    for step in range(round(LASTS_S * rate) - 1):
        if step == last:
            throw.rows()["left"].fill_(10_000)
        obs = env.step(policy.act(obs)).final_obs
        sources = part.tells()
        force = sources["peak/hit"].double()
        hit |= force > TOUCHES_N
        now = hit & (left > 0)
        left -= now.long()
        impulse[now] += sources["impulse/hit"].double()[now]
        peak = torch.where(now, torch.maximum(peak, force), peak)
        servo = env.backend.state["qfrc_actuator"][:, 6:].abs().mean(1).double()
        torque += torch.where(now, servo, 0.0)
        counted += now
        aim, pose = env.goal_pose(), env.pose()
        off += torch.where(hit, 0.0, (pose.pos - aim.pos).norm(dim=-1).mean(1).double())
        stood += torch.where(hit, 0.0, servo)
        before += ~hit
        way = (aim.pos - goal.layout.unpacked(goal.goal.now()).pos).norm(dim=-1).mean(1)
        moved = torch.maximum(moved, way.double())
        after += hit
        out += hit & yields.outside
        fell |= pose.pos[:, 0, 2] < FALLEN * height
    env.close()
    missed = torch.where(hit, 1.0, torch.nan).double()
    mean = torque / counted.clamp_min(1.0)
    off, stood = (x / before.clamp_min(1.0) for x in (off, stood))
    rows = impulse.norm(dim=-1), peak, mean, moved, out / after, off, stood
    return (*((r * missed).numpy() for r in rows), fell.numpy())


def slope(levels: Sequence[float], values: np.ndarray) -> tuple[float, float, float]:
    """The slope of `values (A, M)` over the levels, each throw against its own first level, and its
    95 % interval: the mean of the throws' own slopes through 1 at the first level, +- 1.96 errors."""
    a = np.asarray(levels) - levels[0]
    ratio = values / values[:1]
    own = (a[:, None] * (ratio - 1.0)).sum(0) / (a**2).sum()
    own = own[np.isfinite(own)]
    error = 1.96 * float(own.std(ddof=1)) / np.sqrt(len(own))
    mean = float(own.mean())
    return mean, mean - error, mean + error
