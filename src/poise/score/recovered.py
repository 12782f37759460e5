"""Does a character get up and come back? Recovery as Perpetual Humanoid Control tables it (Sec. 4.2).

The paper starts 1,000 trials fallen, 3 m away, or both, against one clip of standing still, and counts
those that reach the reference within 5 and 10 s. It does not say what reaching is. Here the bodies are
on average within `near` m of their reference, and stay there for `held` s from then on; `held` s are
simulated longer than the times asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv, Recovery, Reference, TaskConfig
from poise.env.recovery.clock import FALLEN, FAR, RecoveryClock
from poise.env.recovery.get_up import RecoveryClips
from poise.env.recovery.recovering import Recovering
from poise.errors import PoiseError
from poise.score.episodes import simulate
from poise.settings import plain

#: The fail-states by name.
KINDS: Mapping[str, int] = {"fallen": FALLEN, "far": FAR, "fallen and far": FALLEN | FAR}

#: The times of that table, s.
SECONDS = (5.0, 10.0)


@dataclass(frozen=True)
class Recovered:
    """The trials of one kind.

    kind: of `KINDS`. trials: how many. within: share that was back, of each of the card's times. median
    and slowest: s until back, over the trials that came back at all; NaN if none did.
    """

    kind: str
    trials: int
    within: tuple[float, ...]
    median: float
    slowest: float


@dataclass(frozen=True)
class RecoveryCard:
    """Recovery against one reference.

    method: what was tried. reference: the clip, and frame its frame. seconds: the times. near, held:
    what reaching is, m and s. distance: m from the reference where far trials begin. seed: of all draws.
    """

    method: str
    reference: str
    frame: int
    seconds: tuple[float, ...]
    near: float
    held: float
    distance: tuple[float, float]
    seed: int
    rows: tuple[Recovered, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON data; what is not a number is null."""
        return plain(self)


def trial_task(
    task: TaskConfig, distance: float = 3.0, falls: int = 1000, guided: bool = False
) -> TaskConfig:
    """The task in which recovery is tried: far is exactly `distance` m, and nothing ends or begins anew.

    The rest of `task.recovery` stays: a policy must see a point goal where it learned to; a task without
    recovery gets the paper's.

    falls: different fallen characters. guided: by recovery motions, so that no goal is a point and no
        reference waits.
    """
    recovery = task.recovery or Recovery.phc()
    drop = replace(recovery.drop, count=falls)
    recovery = replace(recovery, distance=(distance, distance), by_area=False, drop=drop)
    if guided:
        recovery = replace(recovery, switch=math.inf, grace=0)
    return replace(task, auto_reset=False, recovery=recovery)


def recovery_card(
    make_env: Callable[[int], ImitationEnv],
    policy: Acts,
    trials: int = 1000,
    *,
    method: str = "",
    clip: int = 0,
    frame: int = 0,
    kinds: Sequence[str] = tuple(KINDS),
    seconds: Sequence[float] = SECONDS,
    near: float = 0.5,
    held: float = 0.5,
    seed: int = 4242,
    at_once: int = 250,
    recovery_clips: RecoveryClips | None = None,
) -> RecoveryCard:
    """Trials of every kind with a deterministic policy.

    Args:
        make_env: gives an environment of N worlds with a `trial_task`.
        clip, frame: where the reference starts. One that stands still is the paper's; a clip that ends
            before the trials goes on standing on its last frame. It waits for the fallen as in training.
        near, held: m and s, see the module. seed: of falls and directions, other ones than in training.
        at_once: trials that are simulated side by side.
        recovery_clips: what the policy is led back by (`env.recovery`), where the task is for that; by
            default it is told a point.

    Raises:
        PoiseError: a kind that there is not, a clip that there is not, or a task without recovery.
    """
    unknown = [k for k in kinds if k not in KINDS]
    if unknown or not kinds or trials < 1 or not seconds:
        what = f"there is no fail-state '{unknown[0]}'" if unknown else "nothing is asked for"
        raise PoiseError(
            what,
            "recovery",
            f"Fail-states are {', '.join(KINDS)}",
            code="unknown-fall-state" if unknown else "argument-missing",
        )
    env = make_env(min(trials, at_once))
    try:
        clock = env.event(RecoveryClock)
        if clock is None or env.task.auto_reset:
            raise PoiseError(
                "the task is none for trials of recovery",
                hint="Make it with trial_task",
                code="task-unfit",
            )
        if not 0 <= clip < len(env.reference.names):
            raise PoiseError(
                f"there is no clip {clip}, they are 0 to {len(env.reference.names) - 1}",
                code="index-outside",
            )
        env.reseed(seed)
        clock.drop_anew(seed)
        rate, rows = env.reference.rate_hz, []
        stay = max(1, math.ceil(held * rate))
        steps = math.ceil(max(seconds) * rate) + stay - 1
        for kind in kinds:
            parts = -(-trials // env.num_envs)
            trial = (clip, frame, KINDS[kind], steps, recovery_clips)
            apart = [_trial(env, policy, *trial) for _ in range(parts)]
            back = back_after(torch.cat(apart)[:trials] < near, stay) / rate
            rows.append(_row(kind, back, seconds))
        name, distance = env.reference.names[clip], clock.config.distance
    finally:
        env.close()
    times = tuple(float(s) for s in seconds)
    return RecoveryCard(method, name, frame, times, near, held, distance, seed, tuple(rows))


def back_after(near: Tensor, stay: int) -> Tensor:
    """First steps `(E,)` from which `near (E, T)` holds for `stay` steps, counted from 1; inf: none."""
    if near.shape[1] < stay:
        return torch.full((len(near),), math.inf)
    runs = near.unfold(1, stay, 1).all(-1)
    first = runs.int().argmax(1) + 1
    return torch.where(runs.any(1), first.double(), math.inf)


class _Apart:
    """Observes how far the bodies are from their reference on average, m, after each step."""

    def __init__(self, reference: Reference, clip: Tensor, led: Recovering | None):
        self.reference, self.clip, self.led = reference, clip, led
        self.apart: list[Tensor] = []
        self._at: Tensor | None = None

    def see(self, env: ImitationEnv, step: int) -> None:
        if step:
            ref = self.reference.gather(self.clip, env.frame if self._at is None else self._at)
            self.apart.append((env.pose().pos - ref.pos).norm(dim=-1).mean(-1).cpu())
        # Where a goal leads back, the frame that was told before the step.
        self._at = None if self.led is None else self.led.clips.frame.clone()


def _trial(
    env: ImitationEnv,
    policy: Acts,
    clip: int,
    frame: int,
    kind: int,
    steps: int,
    recovery_clips: RecoveryClips | None,
) -> Tensor:
    """Mean distance of the bodies from their reference after each step, m `(N, steps)` on the CPU."""
    many, reference, led = env.clip.new_ones(env.num_envs), env.reference, None
    env.set_goal(env.goal.clips)
    obs = env.reset_to(clip * many, frame * many, kind * many)
    if recovery_clips is not None:
        led = Recovering(env.goal.clips, recovery_clips)
        led.lead(torch.arange(env.num_envs), env.backend.state.qpos)
        obs = env.set_goal(led)
    seen = _Apart(reference, clip * many, led)
    simulate(env, policy, obs, steps, seen)
    return torch.stack(seen.apart, 1)


def _row(kind: str, back: Tensor, seconds: Sequence[float]) -> Recovered:
    came = back[back.isfinite()]
    within = tuple(float((back <= s + 1e-9).double().mean()) for s in seconds)
    median, slowest = (float(came.median()), float(came.max())) if len(came) else (math.nan, math.nan)
    return Recovered(kind, len(back), within, median, slowest)
