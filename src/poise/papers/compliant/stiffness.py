"""How stiff a standing character is at its hands: what is commanded against what is measured.

As roboticists do: a constant force along an axis, and how far the hand is off where it stands without
the force, once it has come to rest; K = f / x along the force.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from poise.control import Compliance, Stiffness
from poise.env.plugins import Felt, Plugin
from poise.env.yielding import Yielding
from poise.errors import PoiseError
from poise.jobs.tracker import Tracker
from poise.papers.compliant.standing import standing
from poise.sim import Backend, Drive

#: Directions that are pushed in, world axes.
AXES = (
    (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0,
    -1.0),
)  # fmt: skip
#: s: the character stands, is pushed, and its hand is looked at in the last of it.
STANDS_S, PUSHED_S, SEEN_S = 2.0, 3.0, 1.0
#: N, with which hands are pushed at most: by 20 N some make a step, and what is measured is the step.
MOST_N = 10.0
#: Share of the pelvis' height below which the character has fallen.
FALLEN = 0.7


@dataclass(frozen=True)
class Measured:
    """One hand, pushed in one direction.

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


class _Held(Plugin):
    """A constant force on one body of each character, while it is on."""

    def __init__(self, backend: Backend, body: Tensor, force: Tensor):
        self.backend, self.body, self.force, self.on = backend, body, force, False
        self._every = torch.arange(len(body))

    def push(self, drive: Drive) -> None:
        """Adds the force."""
        if self.on:
            drive.xfrc_applied[self._every, self.body, :3] += self.force

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
        raise PoiseError("the body has no hands, at which stiffness is measured")
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

    def hold(goal: object, backend: Backend) -> Plugin:
        held.append(_Held(backend, body, force))
        return held[0]

    own = replace(task.task, plugins=(hold,), compliance=given, dones=(), help_by="all")
    env = replace(task, task=own).env(
        len(rows), auto_reset=False, threads=threads, help_scale=0.0, guard=False
    )
    yields = env.plugin(Yielding)
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
