"""A motion with forces in it: what pushes, what is held, how the character gives way, and what came of
it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable, Humanoid
from poise.control import Compliance, Stiffness
from poise.control.compliance import Level, NewtonsPerMetre
from poise.env import ImitationEnv
from poise.env.pushes import HeldThing, Push, Pushes
from poise.env.yielding import DisplacedGoal, Yielding
from poise.errors import PoiseError, did_you_mean
from poise.motion.rotations import GRAVITY, quat_rotate
from poise.recipes.imitation import Imitation
from poise.settings import Range, validate

#: N; more is no push.
MOST_N = 10_000.0
#: kg; nobody lifts more.
MOST_KG = 200.0
#: s after a force for which the body's distance from the motion counts.
AFTER_S = 0.5
#: m, how near to the clip a pushed part is back again, and s, for how long it must stay there.
BACK_M, STAYS_S = 0.1, 0.5
#: Kinds of the body table by the words for what is pushed.
KINDS = {
    "hand": "hand", "elbow": "forearm", "shoulder": "upper_arm", "head": "head", "chest": "spine",
    "pelvis": "pelvis", "root": "pelvis", "hip": "thigh", "knee": "shin", "foot": "foot",
}  # fmt: skip
MIDDLE = ("head", "chest", "pelvis", "root")


@dataclass(frozen=True)
class PushConfig:
    """A push, and how the character gives way to it.

    Attributes:
        newtons: the force.
        at: the part that it is on: hand, elbow, shoulder, hip, knee, foot (the right one; "left_hand" is
            the other), head, chest, pelvis, or a body by its name. It acts at the part's centre of mass.
        start_s, seconds: when it begins in the motion, and how long it lasts.
        direction: in the world, Z up, of any length; None pushes from the front, where the pelvis looks
            when it begins.
        level: of compliance, see `control.Compliance`.
        stiffness: N/m, in place of the level: a commanded stiffness, see `control.Stiffness`.
        law: of the level.
    """

    newtons: Annotated[float, Range(0, MOST_N, above=True, unit="N")] = 150.0
    at: str = "hand"
    start_s: Annotated[float, Range(0, unit="s")] = 1.0
    seconds: Annotated[float, Range(0, above=True, unit="s")] = 0.5
    direction: tuple[float, float, float] | None = None
    level: Level = 0.12
    stiffness: NewtonsPerMetre | None = None
    law: Literal["eq8", "algorithm1"] = "eq8"

    def __post_init__(self) -> None:
        validate(self, "the push")
        if self.direction is not None and not any(self.direction):
            raise PoiseError(
                f"a direction must be three numbers, not all 0, got {self.direction}",
                code="no-direction",
            )

    @property
    def yields(self) -> Compliance | Stiffness:
        """How the character gives way."""
        if self.stiffness is not None:
            return Stiffness(self.stiffness)
        return Compliance(self.level, self.law)


@dataclass(frozen=True)
class Pushed:
    """What came of a push.

    Attributes:
        part: the body that was pushed.
        force: N, world axes.
        first_s, last_s: when.
        goal_m: how far the goal gave way at that part, the greatest distance.
        moved_m: how far the part was from where the clip has it, at most from the push on.
        back_s: how long after the push it was back within 0.1 m of the clip, for half a second or to the
            end; None where it was not.
        least_share: share of the displacement that the hinges' ranges let through at the worst moment.
    """

    part: str
    force: tuple[float, float, float]
    first_s: float
    last_s: float
    goal_m: float
    moved_m: float
    back_s: float | None
    least_share: float

    def sentence(self) -> str:
        """The figures in words."""
        newtons = float(np.linalg.norm(self.force))
        impulse = newtons * (self.last_s - self.first_s)
        back = (
            f"was back within {BACK_M:g} m of the clip {self.back_s:.1f} s after the push"
            if self.back_s is not None
            else f"was not back within {BACK_M:g} m of the clip at the end"
        )
        return (
            f"{self.part} was pushed with {newtons:.0f} N from {self.first_s:.2f} to "
            f"{self.last_s:.2f} s ({impulse:.0f} N s): the goal gave way by up to {self.goal_m:.2f} m "
            f"there, the character by {self.moved_m:.2f} m, and it {back}."
        )


@dataclass(frozen=True)
class HeldConfig:
    """A thing in a hand, see `env.pushes.HeldThing`.

    Attributes:
        at: "left_hand", "right_hand", or a body by its name.
        kg: its mass.
        size_m: the edge of the cube that it is.
        start_s, seconds: when it is taken, and for how long.
    """

    at: str
    kg: Annotated[float, Range(0, MOST_KG, above=True, unit="kg")]
    size_m: Annotated[float, Range(0, 2, above=True, unit="m")] = 0.2
    start_s: Annotated[float, Range(0, unit="s")] = 0.0
    seconds: Annotated[float, Range(0, above=True, unit="s")] = 1.0

    def __post_init__(self) -> None:
        validate(self, "the held thing")


@dataclass(frozen=True)
class HeldEffect:
    """The effect of a held thing.

    Attributes:
        part: the body that held it.
        mass_kg: of the thing.
        first_s, last_s: when.
        force_n: N, that it pulled with on average, its weight and its inertia: m |g - a| of the place
            where it is held. most_n: at most.
    """

    part: str
    mass_kg: float
    first_s: float
    last_s: float
    force_n: float
    most_n: float

    def sentence(self) -> str:
        """The figures in words."""
        return (
            f"{self.part} held {self.mass_kg:g} kg from {self.first_s:.2f} to {self.last_s:.2f} s, "
            f"which pulled with {self.force_n:.0f} N on average, {self.most_n:.0f} N at most."
        )


@dataclass(frozen=True)
class ForceEffect:
    """A force in a motion, and how near the body is to the motion with it and without.

    Attributes:
        came: of the force.
        error_mm: mean distance of the bodies from the motion while it acts, and `AFTER_S` longer; of a
            goal that gives way from where it was before.
        without_mm: the same frames of the motion done without any of the forces.
    """

    came: Pushed | HeldEffect
    error_mm: float
    without_mm: float

    @classmethod
    def between(
        cls, came: Pushed | HeldEffect, pos: Tensor, without: Tensor, goals: Tensor, rate_hz: float
    ) -> ForceEffect:
        """Of the bodies' places `(T, B, 3)` m with the forces and without, and where they are to be."""
        first, last = (round(t * rate_hz) for t in (came.first_s, came.last_s + AFTER_S))
        off = [
            1000
            * float(
                (x[first : last + 1] - goals[first : first + len(x[first : last + 1])])
                .norm(dim=-1)
                .mean()
            )
            for x in (pos, without)
        ]
        return cls(came, *off)

    def sentence(self) -> str:
        """The figures in words."""
        return (
            f"{self.came.sentence()} The body is {self.error_mm:.0f} mm from the motion meanwhile, and "
            f"{self.without_mm:.0f} mm without."
        )

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        kind = "push" if isinstance(self.came, Pushed) else "held"
        mine = {"error_mm": self.error_mm, "without_mm": self.without_mm}
        return {"kind": kind, **asdict(self.came), **mine}


def with_forces(
    imitation: Imitation,
    pushes: Sequence[PushConfig],
    held: Sequence[HeldConfig] = (),
    yields: Compliance | Stiffness | None = None,
) -> Imitation:
    """A task in which the first motion is pushed, and its goal gives way; and in which its hands hold
    things.

    Args:
        yields: how it gives way; by default as the first push says. Held things move no goal.

    Raises:
        PoiseError: the body has no such part, the motion ends before a force begins, or a hand holds two
            things at once.
    """
    reference, table = imitation.reference, imitation.humanoid.table
    rate, frames = reference.rate_hz, int(reference.length[0])
    events: list[Push | HeldThing] = []
    for k, push in enumerate(pushes):
        first = _begins(push.start_s, rate, frames, "the push")
        way = push.direction or from_the_front(imitation.humanoid, reference.qpos[first])
        unit = np.asarray(way, dtype=float) / np.linalg.norm(way)
        x, y, z = (float(push.newtons * v) for v in unit)
        steps, name = max(1, round(push.seconds * rate)), "one push" if k == 0 else f"push {k + 1}"
        events.append(Push(row_of(table, push.at), (x, y, z), first, steps, name=name))
    for k, thing in enumerate(held):
        first = _begins(thing.start_s, rate, frames, "the held thing")
        row, steps = row_of(table, thing.at), max(1, round(thing.seconds * rate))
        _check_free(row, first, steps, events, thing)
        events.append(HeldThing(row, thing.kg, thing.size_m, first, steps, f"held thing {k + 1}"))
    if not events:
        return imitation
    law = yields or (pushes[0].yields if pushes else imitation.task.compliance)
    task = replace(imitation.task, events=(*imitation.task.events, *events), compliance=law)
    return replace(imitation, task=task)


def _begins(start_s: float, rate: float, frames: int, what: str) -> int:
    first = round(start_s * rate)
    if first >= frames - 1:
        raise PoiseError(
            f"{what} begins at {start_s:g} s, and the motion lasts {(frames - 1) / rate:.2f} s",
            hint="Let it begin earlier",
            code="push-too-late",
        )
    return first


def _check_free(
    row: int, first: int, steps: int, events: Sequence[Push | HeldThing], thing: HeldConfig
) -> None:
    for other in events:
        apart = first >= other.first + other.steps or other.first >= first + steps
        if isinstance(other, HeldThing) and other.row == row and not apart:
            raise PoiseError(
                f"{thing.at} is to hold two things at once",
                hint="Let it hold one after the other, or one of their masses together",
                code="settings-conflict",
            )


def without_forces(imitation: Imitation) -> Imitation:
    """The same task without pushes, held things and a goal that gives way."""
    events = tuple(e for e in imitation.task.events if not isinstance(e, Push | HeldThing))
    return replace(imitation, task=replace(imitation.task, events=events, compliance=None))


def unforeseen(imitation: Imitation) -> Imitation:
    """The same task for copies in which a controller looks ahead: they know of no push to come."""
    events = tuple(
        replace(p, foreseen=False) if isinstance(p, Push | Pushes) else p for p in imitation.task.events
    )
    return replace(imitation, task=replace(imitation.task, events=events))


def row_of(table: BodyTable, at: str) -> int:
    """The row of a body table that is pushed, see `PushConfig.at`.

    Raises:
        PoiseError: there is no such part.
    """
    names = [r.name for r in table.rows]
    if at in names:
        return names.index(at)
    side, _, word = at.rpartition("_")
    if word in KINDS and side in ("", "left", "right"):
        kind = KINDS[word]
        rows = [i for i, r in enumerate(table.rows) if r.kind == kind]
        if word not in MIDDLE:
            rows = [i for i in rows if table.rows[i].side == (side or "right")]
        if rows and (word not in MIDDLE or not side):
            return rows[-1]
        if not side or word not in MIDDLE:
            raise PoiseError(
                f"the body has no {at.replace('_', ' ')} to push",
                hint=_known(names),
                code="body-part-missing",
            )
    raise PoiseError(
        f"there is no part '{at}' to push", hint=_known(names, at), code="unknown-body-part"
    )


def _known(names: list[str], at: str = "") -> str:
    words = [*KINDS, *(f"left_{w}" for w in KINDS if w not in MIDDLE)]
    return did_you_mean(at, [*words, *names]) if at else f"It has: {', '.join(names)}"


def way_of(text: str, option: str = "--direction") -> tuple[float, float, float]:
    """The numbers of a direction such as "0,1,0", which an option states.

    Raises:
        PoiseError: these are not three numbers.
    """
    try:
        x, y, z = (float(v) for v in text.split(","))
    except ValueError:
        raise PoiseError(
            f"{option} needs three numbers, got '{text}'",
            hint="Write for example 0,1,0",
            code="option-malformed",
        ) from None
    return x, y, z


def from_the_front(humanoid: Humanoid, qpos: Tensor) -> tuple[float, float, float]:
    """The horizontal direction that a character at `qpos (7 + n)` is pushed in from the front."""
    left = quat_rotate(qpos[3:7].double(), torch.tensor(humanoid.left, dtype=torch.float64))
    # Forward is left x up.
    forward = torch.linalg.cross(left, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    size = float(forward.norm())
    x, y = (float(v) / size for v in forward[:2]) if size > 1e-6 else (1.0, 0.0)
    return -x, -y, 0.0


def back_after(moved: Sequence[float], rate_hz: float) -> float | None:
    """s after which a part stays within `BACK_M` for `STAYS_S`, or to the end; None where it does not.

    moved: m, how far it is off in each frame from the end of the push on.
    """
    stays = max(1, round(STAYS_S * rate_hz))
    for k in range(len(moved)):
        if max(moved[k : k + stays]) <= BACK_M:
            return k / rate_hz
    return None


class ForcesSeen:
    """An observer of what pushes and held things do to the first character.

    Attributes:
        arrows: of each frame `(K, 6)`: the point, m, and the force there, N, world axes: of pushes, and
            of the weight of what is held.
    """

    def __init__(self) -> None:
        self.arrows: list[np.ndarray] = []
        self._pushes, self._held = list[_PushSeen](), list[_HeldSeen]()

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps the frame `step`; it never needs more of them."""
        if not self.arrows:
            self._pushes = [_PushSeen(e) for e in env.events if isinstance(e, Push)]
            self._held = [_HeldSeen(e) for e in env.events if isinstance(e, HeldThing)]
        rows = [one.see(env) for one in (*self._pushes, *self._held)]
        self.arrows.append(np.concatenate(rows) if rows else np.zeros((0, 6)))
        return True

    def came(self, humanoid: Humanoid, rate_hz: float) -> tuple[Pushed | HeldEffect, ...]:
        """The effect of each, pushes first."""
        return tuple(one.came(humanoid, rate_hz) for one in (*self._pushes, *self._held))


class _PushSeen:
    """A push as it is recorded."""

    def __init__(self, push: Push):
        self._push = push
        self._goal, self._moved, self._share = list[float](), list[float](), 1.0
        self._pushed = list[bool]()

    def see(self, env: ImitationEnv) -> np.ndarray:
        """Keeps a frame, and gives its arrow."""
        part, yielding, goal = self._push, env.event(Yielding), env.goal
        assert yielding is not None and isinstance(goal, DisplacedGoal)
        row, acts = part.row, bool(part.acts[0])
        felt = part.felt()
        arrow = torch.cat((felt.point[0], felt.force[0]), 1).double().cpu().numpy()
        clip = goal.layout.unpacked(goal.goal.now()).pos[0, row]
        self._goal.append(float((env.goal_pose().pos[0, row] - clip).norm()))
        self._moved.append(float((env.pose().pos[0, row] - clip).norm()))
        self._share = min(self._share, float(yielding.share[0])) if any(self._pushed) else 1.0
        self._pushed.append(acts)
        return arrow if acts else arrow[:0]

    def came(self, humanoid: Humanoid, rate_hz: float) -> Pushed:
        """Its effect."""
        push = self._push
        first = min(push.first, len(self._moved) - 1)
        last = min(push.first + push.steps, len(self._moved) - 1)
        back = back_after(self._moved[last:], rate_hz)
        return Pushed(
            humanoid.bodies[push.row], push.force, first / rate_hz, last / rate_hz,
            max(self._goal[first:]), max(self._moved[first:]), back, self._share,
        )  # fmt: skip


class _HeldSeen:
    """The pull of a held thing as it is recorded."""

    def __init__(self, thing: HeldThing):
        self._thing, self._at = thing, list[np.ndarray]()

    def see(self, env: ImitationEnv) -> np.ndarray:
        """Keeps a frame, and gives the arrow of its weight."""
        at = env.backend.state.xipos[0, self._thing.row + 1].double().cpu().numpy()
        self._at.append(at.copy())
        weight = [*at, 0.0, 0.0, -self._thing.mass * GRAVITY]
        return np.array([weight] if bool(self._thing.held[0]) else []).reshape(-1, 6)

    def came(self, humanoid: Humanoid, rate_hz: float) -> HeldEffect:
        """Its effect."""
        thing, at = self._thing, np.array(self._at)
        first = min(thing.first, len(at) - 1)
        last = min(thing.first + thing.steps, len(at) - 1)
        inside = at[max(0, first - 1) : last + 2]
        faster = np.diff(inside, n=2, axis=0) * rate_hz**2 if len(inside) > 2 else np.zeros((1, 3))
        pull = thing.mass * np.linalg.norm(faster + np.array([0.0, 0.0, GRAVITY]), axis=-1)
        part = humanoid.bodies[thing.row]
        mean, most = float(pull.mean()), float(pull.max())
        return HeldEffect(part, thing.mass, first / rate_hz, last / rate_hz, mean, most)
