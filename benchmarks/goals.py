"""What goals of each kind cost: ms a control step of one character, and control steps a second of many.

    python benchmarks/goals.py --json benchmarks/goals.json

Every kind follows the embedded walk: as a clip, as a stream of its frames, as a generator that repeats
it, displaced by 5 cm, and led back after being lost. The physics and the terms are the same.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from speed import machine
from torch import Tensor

import poise
from poise.env import ImitationEnv
from poise.env.generator import GeneratorGoal
from poise.env.goal import ClipGoal, Goal
from poise.env.recovery.clips import RecoveryClips
from poise.env.recovery.recovering import Recovering
from poise.env.stream import StreamGoal
from poise.env.task import goal_of
from poise.env.yielding import DisplacedGoal
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.sim import make_backend

KINDS = ("clip", "stream", "generator", "displaced", "led")


class Repeats:
    """A generator that goes through a clip again and again, a second at a time."""

    past, future = 1, 30

    def __init__(self, qpos: Tensor, worlds: int):
        self.qpos, self.at = qpos, torch.zeros(worlds, dtype=torch.long)

    def begin(self, count: int, rng: torch.Generator) -> Tensor:
        return self.qpos[:1].expand(count, 1, -1).clone()

    def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        rows = (self.at[ids].unsqueeze(1) + torch.arange(1, self.future + 1)) % len(self.qpos)
        self.at[ids] = rows[:, -1]
        return self.qpos[rows]

    def rows(self) -> Mapping[str, Tensor]:
        return {"at": self.at}


def goal_for(kind: str, task: Imitation, env_goal: ClipGoal) -> Goal:
    """A goal of a kind on the walk."""
    worlds, qpos = env_goal.num_envs, task.reference.qpos
    if kind == "stream":
        return StreamGoal(task.humanoid, task.reference.rate_hz, worlds)
    if kind == "generator":
        return GeneratorGoal(Repeats(qpos, worlds), task.humanoid, task.reference.rate_hz, worlds)
    if kind == "displaced":
        goal = DisplacedGoal(env_goal)
        goal.offset[:, 0] = 0.05
        return goal
    if kind == "led":
        return Recovering(env_goal, RecoveryClips(qpos[0], (qpos,), (qpos,)))
    return env_goal


def measured(task: Imitation, kind: str, worlds: int, steps: int) -> float:
    """Seconds a control step of all worlds, the median of `steps`."""
    backend = make_backend(task.model, worlds, "cpu", threads=1)
    plain = replace(task.task, auto_reset=False, help=None)
    goal = goal_for(kind, task, goal_of(task.reference, plain, backend, 0, None))
    if isinstance(goal, StreamGoal):
        goal.push(task.reference.qpos[0])
    env = ImitationEnv(goal, backend, plain, task.config.sim.substeps)
    env.help.set(0.0)
    env.reset()
    action, spent = torch.zeros(worlds, env.num_actions), []
    frames = len(task.reference.qpos)
    for k in range(steps):
        began = time.perf_counter()
        if isinstance(goal, StreamGoal):
            goal.push(task.reference.qpos[(k + 1) % frames])
        env.step(action)
        spent.append(time.perf_counter() - began)
    env.close()
    return statistics.median(spent)


def main(argv: list[str] | None = None) -> int:
    """Measures in turns, prints, and saves where it is asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=3)
    given = parser.parse_args(argv)
    torch.set_num_threads(1)
    task = build(Path(poise.__file__).parent / "data/walk.bvh", ResidualForce(num_envs=1))
    found: dict[str, dict[str, float]] = {}
    for _ in range(given.repeats):
        for kind in KINDS:
            one = 1000 * measured(task, kind, 1, given.steps)
            many = given.worlds / measured(task, kind, given.worlds, max(5, given.steps // 5))
            row = found.setdefault(kind, {"ms": one, "steps_per_s": many})
            row |= {"ms": min(row["ms"], one), "steps_per_s": max(row["steps_per_s"], many)}
    clip = found["clip"]
    for kind, row in found.items():
        row["of_clip"] = row["steps_per_s"] / clip["steps_per_s"]
        sys.stdout.write(
            f"{kind:<10} {row['ms']:6.3f} ms, {row['steps_per_s']:9,.0f} steps/s, "
            f"{100 * row['of_clip']:.0f} % of the clip's\n"
        )
    if given.json is not None:
        said = {"command": "benchmarks/goals.py", "machine": machine(), "worlds": given.worlds}
        given.json.write_text(json.dumps({**said, "goals": found}, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
