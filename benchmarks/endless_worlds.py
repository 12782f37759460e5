"""Rollouts of motion without end side by side: as many worlds, stepped together, the policy alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from poise.env import ImitationEnv
from poise.env.generator import GeneratorGoal, Steering
from poise.env.recovery.recovering import FALLS, TRACKS, Recovering
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.score import simulate
from poise.sim.guard import UnstableError
from poise.synthesis.generator import Kinematic

#: Frames between two looks at how far it is; s for which what is down in the end is waited for.
LOOK, AFTER_S = 900, 15.0


@dataclass
class Rollouts:
    """What worlds did.

    Attributes:
        done, asked: `(N, T, 7 + n)`, as it was simulated, and the goals; only `count` frames are there.
        lost, back, reached: (world, s); of those that get up after the end, too.
        bad: how often all worlds began anew since a simulation went bad.
    """

    done: np.ndarray
    asked: np.ndarray
    count: int
    lost: list[tuple[int, float]]
    back: list[tuple[int, float]]
    reached: list[tuple[int, float]]
    bad: int = 0

    def of(self, world: int) -> tuple[list[float], list[float], bool]:
        """s of a world's falls, s that each took until it was up again, and whether it stayed down, also
        `AFTER_S` after the end."""
        falls = [t for i, t in self.lost if i == world]
        ups = [t for i, t in self.back if i == world]
        away = [up - fall for fall, up in zip(falls, ups, strict=False)]
        return falls, away, len(ups) < len(falls)


class _Keeps:
    """Keeps every world's frames."""

    def __init__(self, goal: Recovering, out: Rollouts, look: Callable[[Rollouts], None]):
        self.goal, self.out, self.look = goal, out, look
        self._frames, self.over = out.done.shape[1], False

    def see(self, env: ImitationEnv, step: int) -> bool:
        """One more frame."""
        if step == 0:
            return False
        k = self.out.count
        if k == self._frames:
            # What is down gets up, or does not; frames are not kept any more.
            return bool((self.goal.doing == TRACKS).all())
        self.out.done[:, k] = env.backend.state.qpos
        self.out.asked[:, k] = self.goal.start(None)[0]
        self.out.count += 1
        if self.out.count % LOOK == 0:
            told(self.out, self.goal)
            self.look(self.out)
        # Without recovery there is no more to see once all have fallen.
        self.over = self.goal.get_up is None and bool((self.goal.doing == FALLS).all())
        return self.over


def told(out: Rollouts, goal: Recovering) -> None:
    """Takes the times from a goal; what happens after the end counts only if it is getting up."""
    for name, found in (("lost", goal.lost), ("back", goal.back), ("reached", goal.reached)):
        last = out.count if name != "back" else math.inf
        setattr(out, name, [(i, round(s / goal.rate_hz, 2)) for i, s in found if s <= last])


def rollouts(
    tracker: Tracker, made: Kinematic, count: int, seconds: float,
    look: Callable[[Rollouts], None] = lambda _: None,
    recover: bool = True, past: str = "own", targets: tuple[tuple[float, float], ...] = (),
    label_seconds: float = 10.0, **_: Any,
) -> Rollouts:  # fmt: skip
    """`count` rollouts; number k begins from a past drawn with seed k, all later draws are of seed 0."""
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    task = replace(task, task=replace(task.task, help_by="all"))
    rate, steps = tracker.config.sim.control_hz, round(seconds * tracker.config.sim.control_hz)
    begins = [made.begin(1, torch.Generator().manual_seed(k)) for k in range(count)]
    wishing = made.wishing(0.0 if targets else label_seconds, count)
    motion = GeneratorGoal(
        wishing, tracker.humanoid, rate, count, lead=max(*tracker.config.window, 1) + 1,
        pasts=torch.cat(begins), steering=Steering(targets), simulated=past == "simulated",
    )  # fmt: skip
    goal = Recovering(motion, tracker.recovery_clips if recover else None)
    goal.draw(torch.arange(count))
    width = tracker.humanoid.model.nq
    empty = np.zeros((2, count, steps, width), np.float32)
    out = Rollouts(empty[0], empty[1], 0, [], [], [])
    env = task.env(count, None, False, 1, help_scale=0.0)
    try:
        over = False
        while out.count < steps and not over:
            env.backend.write(None, *goal.start(None))
            env.age[:] = 0
            try:
                keeps = _Keeps(goal, out, look)
                after = round(AFTER_S * rate) if recover else 0
                simulate(env, tracker.policy, env.set_goal(goal), steps - out.count + after, keeps)
                over = keeps.over
            except UnstableError:
                out.bad += 1
                env.action[:] = 0
    finally:
        env.close()
    told(out, goal)
    return out
