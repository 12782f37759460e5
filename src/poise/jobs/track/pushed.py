"""A motion with a push in it: what pushes, how the character gives way, and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable, Humanoid
from poise.control import Compliance, Stiffness
from poise.control.compliance import Level, NewtonsPerMetre
from poise.env import ImitationEnv
from poise.env.pushes import Push, Pushes
from poise.env.yielding import DisplacedGoal
from poise.errors import PoiseError, did_you_mean
from poise.motion.rotations import quat_rotate
from poise.recipes.imitation import Imitation
from poise.settings import Range, validate

#: N; more is no push.
MOST_N = 10_000.0
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


def with_push(imitation: Imitation, push: PushConfig | None) -> Imitation:
    """A task in which the first motion is pushed, and its goal gives way.

    Raises:
        PoiseError: the body has no such part, or the motion ends before the push.
    """
    if push is None:
        return imitation
    reference = imitation.reference
    rate, frames = reference.rate_hz, int(reference.length[0])
    first = round(push.start_s * rate)
    if first >= frames - 1:
        raise PoiseError(
            f"the push begins at {push.start_s:g} s, and the motion lasts {(frames - 1) / rate:.2f} s",
            hint="Let it begin earlier",
            code="push-too-late",
        )
    row = row_of(imitation.humanoid.table, push.at)
    way = push.direction or from_the_front(imitation.humanoid, reference.qpos[first])
    unit = np.asarray(way, dtype=float) / np.linalg.norm(way)
    x, y, z = (float(push.newtons * v) for v in unit)
    made = Push(row, (x, y, z), first, max(1, round(push.seconds * rate)))
    task = replace(imitation.task, events=(*imitation.task.events, made), compliance=push.yields)
    return replace(imitation, task=task)


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


class PushSeen:
    """An observer of what a push does to the first character.

    Attributes:
        arrows: of each frame `(K, 6)`: the point, m, and the force there, N, world axes.
    """

    def __init__(self) -> None:
        self.arrows: list[np.ndarray] = []
        self._goal, self._moved, self._share = list[float](), list[float](), 1.0
        self._pushed = list[bool]()
        self._push: Push | None = None

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps the frame `step`; it never needs more of them."""
        from poise.env.yielding import Yielding

        part, yielding, goal = env.event(Push), env.event(Yielding), env.goal
        assert part is not None and yielding is not None and isinstance(goal, DisplacedGoal)
        self._push, row = part, part.row
        acts = bool(part.acts[0])
        felt = part.felt()
        arrow = torch.cat((felt.point[0], felt.force[0]), 1).double().cpu().numpy()
        self.arrows.append(arrow if acts else arrow[:0])
        clip = goal.layout.unpacked(goal.goal.now()).pos[0, row]
        self._goal.append(float((env.goal_pose().pos[0, row] - clip).norm()))
        self._moved.append(float((env.pose().pos[0, row] - clip).norm()))
        self._share = min(self._share, float(yielding.share[0])) if any(self._pushed) else 1.0
        self._pushed.append(acts)
        return True

    def pushed(self, humanoid: Humanoid, rate_hz: float) -> Pushed:
        """What came of it."""
        push = self._push
        assert push is not None
        first, last = push.first, min(push.first + push.steps, len(self._moved) - 1)
        back = back_after(self._moved[last:], rate_hz)
        return Pushed(
            humanoid.bodies[push.row], push.force, first / rate_hz, last / rate_hz,
            max(self._goal[first:]), max(self._moved[first:]), back, self._share,
        )  # fmt: skip
