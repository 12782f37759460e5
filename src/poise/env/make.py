"""What an environment holds for a task: its goal and its plug-ins."""

from __future__ import annotations

from torch import Tensor

from poise.control import Stiffness
from poise.env.body_assignment import BodyAssignment
from poise.env.goals.clip import ClipGoal
from poise.env.goals.displaced import DisplacedGoal
from poise.env.goals.goal import Goal
from poise.env.help import HelpBudget
from poise.env.plugins import Plugin
from poise.env.recovery.clock import RecoveryClock
from poise.env.reference import Reference
from poise.env.starts import AdaptiveSampling, Starts
from poise.env.task import TaskConfig
from poise.env.yielding import Yielding
from poise.sim import Backend


def goal_of(
    reference: Reference, task: TaskConfig, backend: Backend, seed: int, weights: Tensor | None
) -> ClipGoal:
    """The clips of a reference as a goal, with the task's starts."""
    bins = reference.bins, task.adaptive, task.adaptive_over
    starts = Starts(reference.length, weights, seed, task.first, *bins)
    return ClipGoal(reference, backend.num_envs, backend.device, starts)


def plugins_of(
    task: TaskConfig, goal: Goal, backend: Backend, seed: int
) -> tuple[HelpBudget, tuple[Plugin, ...]]:
    """The budget of help, and the plug-ins of a task in the order in which they are asked."""
    schedule = task.help if task.auto_reset and task.residual else None
    budget = HelpBudget(schedule, backend.device, goal.groups(task.help_by), task.help_by)
    out: list[Plugin] = []
    if task.adaptive and task.auto_reset:
        sampling = AdaptiveSampling(goal.groups("bin"), backend.device)
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
    own = [make(goal, backend) for make in task.plugins]
    out += [*([clock] if clock else []), *own]
    if task.compliance is not None:
        assert isinstance(goal, DisplacedGoal)
        additive = task.pd.mode == "additive"
        out.append(Yielding(task.compliance, goal, backend, additive, tuple(out)))
    return budget, tuple(out)


def displaced_goal(goal: Goal, task: TaskConfig) -> Goal:
    """A goal that what pushes can displace, where the task has compliance."""
    if task.compliance is None or isinstance(goal, DisplacedGoal):
        return goal
    hindsight = isinstance(task.compliance, Stiffness) and task.compliance.hindsight
    return DisplacedGoal(goal, hindsight)
