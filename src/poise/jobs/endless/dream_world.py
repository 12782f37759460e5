"""The things in the world of characters that go about: boxes, seats, pushes, a hand that helps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import torch

from poise.control import ImplicitResidual
from poise.env.generator_goal import Footprint
from poise.env.pushes import Pushes
from poise.env.recovery.seats import HIGHEST, LOWEST, WIDE, Seat
from poise.errors import PoiseError
from poise.jobs.track.pushed import MOST_N, row_of
from poise.jobs.track.surroundings import places
from poise.jobs.tracker import Tracker
from poise.kinematics.supports import Support
from poise.plan.expert import GoalGuide
from poise.recipes.imitation import Imitation
from poise.settings import Range, validate
from poise.sim.props import Box

#: m about the place where a character begins in which nothing stands.
ROOM_M = 0.4


@dataclass(frozen=True)
class DreamPush:
    """A push on each character, once or again and again; the words are those of `PushConfig`.

    Attributes:
        newtons: the force.
        at: the part that it is on, see `PushConfig`.
        start_s, seconds: when the first one begins, and how long each lasts.
        direction: in the world, Z up, of any length; "front" pushes each character against where it
            faces when the push begins, "any" to a horizontal direction that is drawn.
        every_s: between which the s from the end of one to the begin of the next are drawn; None for a
            single push.
    """

    newtons: Annotated[float, Range(0, MOST_N, above=True, unit="N")] = 150.0
    at: str = "hand"
    start_s: Annotated[float, Range(0, unit="s")] = 1.0
    seconds: Annotated[float, Range(0, above=True, unit="s")] = 0.5
    direction: tuple[float, float, float] | Literal["front", "any"] = "front"
    every_s: Annotated[tuple[float, float] | None, Range(0, above=True, rising=True, unit="s")] = None

    def __post_init__(self) -> None:
        validate(self, "the push")
        if isinstance(self.direction, tuple) and not any(self.direction):
            raise PoiseError(
                f"a direction must be three numbers, not all 0, got {self.direction}",
                code="no-direction",
            )


def with_pushes(task: Imitation, pushes: Sequence[DreamPush], seed: int) -> Imitation:
    """A task whose characters are pushed.

    Raises:
        PoiseError: the body has no such part.
    """
    rate, never = task.config.sim.control_hz, (math.inf, math.inf)
    events = [
        Pushes(
            (p.newtons, p.newtons),
            p.every_s or never,
            p.seconds,
            (row_of(task.humanoid.table, p.at),),
            rate,
            seed + k,
            first_s=p.start_s,
            direction=p.direction,
            name=f"push {k}",
        )
        for k, p in enumerate(pushes)
    ]
    own = replace(task.task, events=(*task.task.events, *events))
    return replace(task, task=own)


def with_boxes(task: Imitation, supports: Sequence[Support], count: int) -> Imitation:
    """A task in whose world boxes stand that nothing moves.

    Raises:
        PoiseError: a character would begin in one.
    """
    for k, support in enumerate(supports, 1):
        foot = footprint(support)
        for x, y in places(count).tolist():
            if bool(foot.depth(torch.tensor([x, y]), ROOM_M) > 0):
                raise PoiseError(
                    f"a character begins at ({x:g}, {y:g}) m, and {support.kind} {k} stands there",
                    "the scene",
                    f"Leave {ROOM_M:g} m about that place free",
                    code="bodies-overlap",
                )
    boxes = tuple(Box(f"{s.kind}{k}", s.size, s.pos, s.quat) for k, s in enumerate(supports, 1))
    return replace(task, props=(*task.props, *boxes))


def footprint(support: Support) -> Footprint:
    """A support as it is seen from above."""
    return Footprint(support.pos[:2], support.size[:2], support.yaw)


def seats_of(supports: Sequence[Support]) -> tuple[list[Seat], list[str]]:
    """The seats among supports, and sentences on those that nobody can sit down on."""
    seats, said = list[Seat](), list[str]()
    for support in supports:
        if support.kind != "seat":
            continue
        x, y = support.pos[:2]
        where = f"The seat at ({x:.2f}, {y:.2f}) m is"
        if not LOWEST <= support.top <= HIGHEST:
            high = f"{support.top:.2f} m high, and one from {LOWEST:g} to {HIGHEST:g} m is sat on"
            said.append(f"{where} {high}; characters walk round it.")
        elif min(support.size[:2]) < WIDE:
            narrow = f"{min(support.size[:2]):.2f} m wide, and one of {WIDE:g} m or more is sat on"
            said.append(f"{where} {narrow}; characters walk round it.")
        else:
            seats.append(Seat(footprint(support), support.top))
    return seats, said


def with_help(task: Imitation, tracker: Tracker, limit_n: float) -> tuple[Imitation, Tracker]:
    """A task in which a hand leads the roots by up to `limit_n` N and N m, and the tracker whose actions
    have no part in that."""
    residual, hinges = ImplicitResidual(limit_n, limit_n), len(task.humanoid.hinges)
    policy = tracker.policy.with_actions(hinges).with_actions(hinges + residual.dims)
    guide = GoalGuide(task.reference, residual)
    own = replace(task.task, residual=residual, help_by="all", guide=guide)
    return replace(task, task=own), replace(tracker, policy=policy)
