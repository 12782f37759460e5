"""The set-up of a scene of compliance in each world, and its events."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar, NamedTuple, Protocol

from poise.body import Humanoid
from poise.control import Compliance, Stiffness
from poise.env.events import Event
from poise.env.frame import DoneTerm, ObsTerm, RewardTerm
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
