"""A task's parts, the result of one of its control steps, and the parts an environment makes for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from poise.control import Compliance, HelpSchedule, PDTargets, Residual, Stiffness, Wrench
from poise.env.events import AdaptiveSampling, BodyAssignment, Event
from poise.env.frame import DoneTerm, Observable, ObsTerm, RewardTerm
from poise.env.goal import ClipGoal, Goal
from poise.env.help import HelpBudget
from poise.env.recovery.clock import Recovery, RecoveryClock
from poise.env.reference import Reference
from poise.env.starts import Starts
from poise.env.yielding import DisplacedGoal, Yielding
from poise.errors import PoiseError
from poise.settings import Range, validate
from poise.sim import Backend, SimState


class Acts(Protocol):
    """Anything that maps observations `(N, O)` to deterministic actions `(N, A)`."""

    def act(self, obs: Tensor) -> Tensor: ...


class Guides(Protocol):
    """Residual actions `(N, dims)` that lead characters along their goal, see `plan.guide`."""

    def __call__(self, state: SimState, goal: Goal) -> Tensor: ...


class EnvStep(NamedTuple):
    """One control step; see `poise.learn.protocols.Step` for what the learner reads in it.

    obs, final_obs `(N, O)`; reward `(N,)`; terminated (failed, or the clip was done to its end),
    truncated (time-out), failed `(N,)` bool; log: means by name.
    `obs` lies in a buffer that the next step fills again.
    """

    obs: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    final_obs: Tensor
    log: Mapping[str, float]
    failed: Tensor


@dataclass(frozen=True)
class TaskConfig:
    """A task as terms.

    obs, rewards, dones: the terms, in order.
    pd: how actions become joint targets.
    residual: the kind of residual force, None for plain DeepMimic.
    guide: residual actions that are added to the policy's while there is help, None for none.
    help: how its limits change while episodes are counted, which is with auto_reset alone; None leaves
        them.
    help_by: whether "all" worlds have one share of help left, or each "clip" or each motion "bin" its
        own, see `HelpBudget`.
    left: `(3,)` the root's local axis that points to the body's left (`Humanoid.left`): the heading of
        every pose that a term sees is where it points on the ground, see `rotations.lateral_heading`;
        None takes the root's twist about +Z.
    filter: share f of the last action that the hinges' actions keep, a_t = (1 - f) u_t + f a_(t-1) for
        what is given, u_t; what acts, counts and is copied is a_t. The first of an episode is taken as
        it is. 0 filters nothing.
    window: control steps ahead for which terms may ask besides the next one, see `Frame.window`.
    horizon: control steps until an episode times out.
    completion_bonus: what a clip done to its end is worth, in rewards of its last step; a discount g
        makes g / (1 - g) of a character that goes on as it ended.
    first: share of the episodes that begin on their clip's frame 0, as evaluations do.
    adaptive: share of the others that begin before motion bins in which episodes lately failed.
    adaptive_over: bins of the drawn "clip", or of the whole "library", see `Starts`.
    style: what a motion prior sees of a frame, terms that look at `frame.sim` alone, see
        `ImitationEnv.features`.
    auto_reset: start a new episode where one ended (off while evaluating).
    recovery: falls and getting up, being far and coming back as part of the episodes, see
        `poise.env.recovery.clock`; None for episodes that begin and stay on their clip.
    compliance: how goals give way where something pushes the characters, see `env.yielding`: by the
        paper's law, or by a commanded stiffness; None: they do not.
    observables: more of what terms can ask a frame for, by name, see `env.frame`.
    velocities: columns of the observations, next to each other, that tell how far velocities are off the
        goal's: what a smooth policy shall not answer to (`PPOConfig.smooth_weight`).
    events: make more parts of an environment, each of its goal and backend, see `env.events`.
    """

    obs: tuple[ObsTerm, ...]
    rewards: tuple[RewardTerm, ...]
    dones: tuple[DoneTerm, ...]
    pd: PDTargets
    residual: Residual | None = None
    guide: Guides | None = None
    help: HelpSchedule | None = None
    help_by: Literal["all", "clip", "bin"] = "all"
    left: Tensor | None = None
    filter: Annotated[float, Range(0, 1, below=True)] = 0.0
    window: tuple[int, ...] = ()
    horizon: int = 300
    completion_bonus: float = 0.0
    first: float = 0.0
    adaptive: float = 0.0
    adaptive_over: Literal["clip", "library"] = "clip"
    style: tuple[ObsTerm, ...] = ()
    auto_reset: bool = True
    recovery: Recovery | None = None
    compliance: Compliance | Stiffness | None = None
    observables: Mapping[str, Observable] = field(default_factory=dict)
    velocities: tuple[str, ...] = ()
    events: tuple[Callable[[Goal, Backend], Event], ...] = ()

    def __post_init__(self) -> None:
        validate(self)
        for terms in (self.obs, self.rewards, self.dones):
            names = [t.name for t in terms]
            twice = [n for n in names if names.count(n) > 1]
            if twice:
                raise PoiseError(
                    f"two terms are called '{twice[0]}'",
                    "TaskConfig",
                    "Rename one of them",
                    code="name-repeated",
                )
        lost = [r.name for r in self.rewards if r.when == "far"]
        if lost and self.recovery is None:
            raise PoiseError(
                f"the reward '{lost[0]}' counts far from the reference alone, and no world is ever far",
                hint="Set TaskConfig.recovery, for instance to Recovery.phc()",
                code="recovery-off",
            )


class StepLog(Mapping[str, float]):
    """Means over the worlds: "reward/NAME" of every term, "imitation", the help in N and N m,
    the limit of its force in N (`limit_n`, a number or `(N,)`, None without one), and whatever `more`
    there is.

    All of them come by one pass and one wait for the numbers, at the first that is read.
    """

    def __init__(
        self,
        terms: Mapping[str, Tensor],
        imitation: Tensor,
        wrench: Wrench | None,
        limit_n: float | Tensor | None,
        more: Mapping[str, Tensor] | None = None,
    ):
        self._parts = terms, imitation, wrench, limit_n, more or {}
        self._values: dict[str, float] | None = None

    def _read(self) -> dict[str, float]:
        if self._values is None:
            terms, imitation, wrench, limit_n, more = self._parts
            rows = {**{f"reward/{name}": value for name, value in terms.items()}, "imitation": imitation}
            if wrench is not None:
                rows["help/force_n"] = wrench.force.norm(dim=-1).sum(-1)
                rows["help/torque_nm"] = wrench.torque.norm(dim=-1).sum(-1)
            rows.update(more)
            if wrench is not None and isinstance(limit_n, Tensor):
                rows["help/limit_n"] = limit_n
            means = torch.stack(list(rows.values())).mean(-1).tolist()
            self._values = dict(zip(rows, means, strict=True))
            if wrench is not None and isinstance(limit_n, float | int):
                self._values["help/limit_n"] = limit_n
        return self._values

    def __getitem__(self, name: str) -> float:
        return self._read()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._read())

    def __len__(self) -> int:
        return len(self._read())


def goal_of(
    reference: Reference, task: TaskConfig, backend: Backend, seed: int, weights: Tensor | None
) -> ClipGoal:
    """The clips of a reference as a goal, with the task's starts."""
    bins = reference.bins, task.adaptive, task.adaptive_over
    starts = Starts(reference.length, weights, seed, task.first, *bins)
    return ClipGoal(reference, backend.num_envs, backend.device, starts)


def events_of(
    task: TaskConfig, goal: Goal, backend: Backend, seed: int
) -> tuple[HelpBudget, tuple[Event, ...]]:
    """The budget of help, and the events of a task in the order in which they are asked."""
    schedule = task.help if task.auto_reset and task.residual else None
    groups = 1 if task.help_by == "all" else goal.clips.groups(task.help_by)
    budget = HelpBudget(schedule, backend.device, groups, task.help_by)
    out: list[Event] = []
    if task.adaptive and task.auto_reset:
        sampling = AdaptiveSampling(goal.clips.groups("bin"), backend.device)
        goal.clips.odds = lambda: sampling.odds
        out.append(sampling)
    out.append(budget)
    if goal.begins:
        budget.use(goal.clips.drawn(task.help_by))
    clock = None
    if task.recovery is not None:
        clock = RecoveryClock(task.recovery, backend, goal.humanoid, task.pd, goal.layout, seed)
    if len(goal.bodies) > 1:
        if clock is not None:
            # Falls are those of the first body, which all worlds still have.
            _ = clock.falls
        out.append(BodyAssignment(backend, goal.bodies))
    out += [*([clock] if clock else []), *(make(goal, backend) for make in task.events)]
    if task.compliance is not None:
        assert isinstance(goal, DisplacedGoal)
        additive = task.pd.mode == "additive"
        # The last one, since it gives way to the forces of all others.
        out.append(Yielding(task.compliance, goal, backend, additive, tuple(out)))
    return budget, tuple(out)


def displaced_goal(goal: Goal, task: TaskConfig) -> Goal:
    """A goal that what pushes can displace, where the task has compliance."""
    if task.compliance is None or isinstance(goal, DisplacedGoal):
        return goal
    hindsight = isinstance(task.compliance, Stiffness) and task.compliance.hindsight
    return DisplacedGoal(goal, hindsight)
