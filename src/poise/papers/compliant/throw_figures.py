"""Obstacles thrown at a character that stands (Deep Compliant Control, Sec. 5.2 and Fig. 4).

A ball of 1 kg comes at 2 to 3 m/s from a random direction, once. The same throws are made at every
level of compliance, and up to the first contact the worlds are the same to the last bit. What is looked
at are the impulse and the greatest force of the contacts per physics step, and the torques of the
servos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from poise.control import Compliance, Stiffness
from poise.env.events import ScenePart
from poise.env.goals import DisplacedGoal
from poise.env.yielding import Yielding
from poise.jobs.tracker import Tracker
from poise.papers.compliant.scenes import Throws
from poise.papers.compliant.standing import standing
from poise.papers.compliant.stiffness import FALLEN
from poise.recipes.imitation import Imitation
from poise.sim import SimConfig

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
        fell: whether the character fell.
    """

    levels: tuple[float, ...]
    impulse: np.ndarray
    peak: np.ndarray
    torque: np.ndarray
    moved: np.ndarray
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
) -> Thrown:
    """The same throws at each level, by the policy alone.

    Args:
        given: how the character gives way; its level or stiffness is what `levels` replace.
        count: of throws.
        rate_hz: of the physics; None for the policy's own.
        show: is told how many levels of how many are done.

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
    own = replace(task.task, plugins=stage.plugins, compliance=given, dones=(), help_by="all")
    task = replace(task, task=own, props=stage.props, touches=stage.touches)
    found = list[tuple[np.ndarray, ...]]()
    for k, level in enumerate(levels):
        found.append(_at(tracker, task, count, threads, level))
        if show is not None:
            show(k + 1, len(levels))
    columns = (np.stack(c) for c in zip(*found, strict=True))
    return Thrown(tuple(levels), *columns)


def _at(
    tracker: Tracker, task: Imitation, count: int, threads: int, level: float
) -> tuple[np.ndarray, ...]:
    """The rows `(M,)` of `Thrown` at one level."""
    env = task.env(count, None, False, threads, help_scale=0.0, guard=False)
    yields = env.plugin(Yielding)
    part, goal = env.plugin(ScenePart), env.goal
    assert yields is not None and part is not None and isinstance(goal, DisplacedGoal)
    throw = part.happenings[1]
    yields.turn(level)
    zero = torch.zeros(count, dtype=torch.long)
    obs, rate = env.reset_to(zero, zero), task.reference.rate_hz
    height = env.pose().pos[:, 0, 2].clone()
    impulse = torch.zeros(count, 3, dtype=torch.float64)
    peak, torque, counted, moved = (torch.zeros(count, dtype=torch.float64) for _ in range(4))
    left = torch.full((count,), round(COUNTS_S * rate))
    hit, fell = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
    # One throw: the next one would be due after the wait again.
    last = round(2.0 * WAITS_S * rate) - 1
    for step in range(round(LASTS_S * rate) - 1):
        if step == last:
            throw.rows()["left"].fill_(10_000)
        obs = env.step(tracker.policy.act(obs)).final_obs
        sources = part.sources()
        force = sources["peak/hit"].double()
        hit |= force > TOUCHES_N
        now = hit & (left > 0)
        left -= now.long()
        impulse[now] += sources["impulse/hit"].double()[now]
        peak = torch.where(now, torch.maximum(peak, force), peak)
        servo = env.backend.state["qfrc_actuator"][:, 6:].abs().mean(1).double()
        torque += torch.where(now, servo, 0.0)
        counted += now
        way = (env.goal_pose().pos - goal.layout.unpacked(goal.goal.now()).pos).norm(dim=-1).mean(1)
        moved = torch.maximum(moved, way.double())
        fell |= env.pose().pos[:, 0, 2] < FALLEN * height
    env.close()
    missed = torch.where(hit, 1.0, torch.nan).double()
    rows = impulse.norm(dim=-1), peak, torque / counted.clamp_min(1.0), moved
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
