"""The set-up of a scene of compliance in each world, and its events."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.control import Compliance, Stiffness
from poise.env.events import EpisodeStart, Event, StatedEvent
from poise.env.frame import DoneTerm, Frame, ObsTerm, RewardTerm
from poise.env.goal import Goal
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.score import Spread
from poise.sim import Backend, Character, Floor, Link, Plane, Touch
from poise.sim.props import Prop

Given = Compliance | Stiffness


def as_given(given: Given | None) -> Given:
    """The paper's compliance where nothing else is stated."""
    return given or Compliance()


class SceneSetup(NamedTuple):
    """What stands in each world beside one character, and what happens to it.

    Attributes:
        props, links, touches: see `sim.Scene`; the character's bodies have their own names.
        events: of the task; those that tell forces (`Event.felt`) are what the character gives way to.
        floor: what they stand on.
        obs, rewards, dones: of a policy that learns the scene: the task's state, reward and failure.
        yields: how a character gives way in the scene, of what is stated, None for nothing.
        from_start: whether episodes begin with the motion's first frame, since the scene goes by time.
    """

    props: tuple[Prop | Character, ...] = ()
    links: tuple[Link, ...] = ()
    touches: tuple[Touch, ...] = ()
    events: tuple[Callable[[Goal, Backend], Event], ...] = ()
    obs: tuple[ObsTerm, ...] = ()
    rewards: tuple[RewardTerm, ...] = ()
    dones: tuple[DoneTerm, ...] = ()
    from_start: bool = False
    floor: Floor = Plane()
    yields: Callable[[Given | None], Given] = as_given


#: Starts of episodes: the paper states none.
STARTS = Spread(0.02, 0.05, 0.1, 0.1, math.radians(10.0))
#: Starts in which something is linked to a hand or stands on the head from the first moment on.
LINKED = Spread(0.02, 0.0, 0.1, 0.1)
#: Hz, of scenes in which bodies meet (Sec. 5.2).
CONTACTS_HZ = 600.0
#: m/s^2; s for which a blow counts after the last force (Fig. 4 looks at as much).
G, AFTER_S = 9.81, 0.5
#: m: the usual torque of a hinge, mean of all, is a character's weight at such an arm.
ARM_M = 0.03


@dataclass(frozen=True)
class StartsOff(StatedEvent[Goal, Backend], Event):
    """Episodes begin off the motion: given to `TaskConfig.events`.

    Attributes:
        spread: by how much.
    """

    spread: Spread

    def enter(self, goal: Goal, backend: Backend) -> None:
        """It keeps nothing of its worlds."""

    def begin(self, episodes: EpisodeStart) -> None:
        qpos, qvel = (x.clone() for x in episodes.start)
        seed = int(torch.randint(2**31, (1,), generator=episodes.rng))
        rng = np.random.default_rng(seed)
        for i in range(len(qpos)):
            self.spread.move(qpos[i], qvel[i], rng)
        episodes.start = qpos, qvel


def eased(humanoid: Humanoid, share: float) -> RewardTerm:
    """The task of a scene in which nothing is to be done but to give way: that forces stay small.

    r = (exp(-f / F) + exp(-t / T)) / 2 up to `AFTER_S` after something was felt, else 1. f is
    "load" of `ScenePart`, N, and t the mean size of the hinges' torques, N m; F is the `share` of the
    character's weight, and T the weight at `ARM_M`.
    """
    weight = humanoid.mass * G
    params = {"newtons": share * weight, "newton_metres": ARM_M * weight}
    return RewardTerm("task/eased", small_forces, 0.5, params, imitation=False)


def feels(humanoid: Humanoid) -> ObsTerm:
    """The state of such a scene: what was felt, and how long ago, without which no value could be told
    of what comes after a blow where nothing gives way."""
    return ObsTerm("task/felt", felt_seen, {"newtons": humanoid.mass * G})


def felt_seen(frame: Frame, newtons: float) -> Tensor:
    """ "load" in `newtons` and exp(-t / T) of the time since, T being `AFTER_S`, `(N, 2)`."""
    since = torch.exp(-frame.source("since") / AFTER_S)
    return torch.stack((frame.source("load") / newtons, since), 1)


def small_forces(
    frame: Frame, newtons: float, newton_metres: float, most: float | None = None
) -> Tensor:
    """The reward `(N,)` of `eased`.

    most: the level of compliance at which all of it is paid; below it a part, and at level 0 nothing is
        paid for giving way. None pays all of it at any level.
    """
    assert frame.torque is not None
    force = torch.exp(-frame.source("load") / newtons)
    torque = torch.exp(-frame.torque.abs().mean(1) / newton_metres)
    lacks = 1.0 - 0.5 * (force + torque)
    if most is not None:
        lacks = (frame.source("compliance/level") / most).clamp(0.0, 1.0).to(lacks) * lacks
    return torch.where(frame.source("since") <= AFTER_S, 1.0 - lacks, 1.0)


class PlayScene(Protocol):
    """The settings of a scene, one file each."""

    rate_hz: ClassVar[float | None]
    """Hz, of its physics; None is the policy's own."""
    starts: ClassVar[Spread]
    """How far its episodes begin from the motion's first frame."""

    def stage(self, humanoid: Humanoid, reference: Reference) -> SceneSetup:
        """What it takes for a body and the motion that it follows.

        Raises:
            PoiseError: the body cannot do it.
        """
        ...


def hand_of(humanoid: Humanoid, side: str, scene: str) -> int:
    """The row of a hand.

    Raises:
        PoiseError: the body has none on that side.
    """
    rows = humanoid.table.rows
    found = next((i for i in humanoid.rows_of("hand") if rows[i].side == side), None)
    if found is None:
        names = ", ".join(humanoid.bodies)
        hint = f"Its bodies are {names}"
        raise PoiseError(
            f"the skeleton has no {side} hand, which '{scene}' needs",
            hint=hint,
            code="body-part-missing",
        )
    return found
