"""A policy that learns to do as another one does, in its own way of observing and acting."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.env.controls import keep_actions
from poise.errors import PoiseError
from poise.jobs.perpetual.stages import Stage, clone_for, odds, practised, staged
from poise.jobs.warm_start import CLONE_WORLDS, TrainingCallbacks
from poise.learn import PolicyBundle, VecEnv, WarmStart, clone
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import stage_task
from poise.recipes.perpetual_settings import Perpetual

if TYPE_CHECKING:
    from poise.jobs.tracker import Tracker

#: Deviation of the noise of absolute actions, which are shares of a joint's range.
STD = 0.02


class PolicyTeacher:
    """Acts in an environment as a policy would that observes it and drives its joints in its own way.

    A teacher for `poise.learn.clone`; the target angles of the joints are the same.

    Args:
        env: where the student acts; it is reset.
        tracker: the policy, on the same body and at the same control rate.

    Raises:
        PoiseError: the environment has several bodies, or another one than the policy.
    """

    def __init__(self, env: ImitationEnv, tracker: Tracker):
        if len(env.goal.bodies) > 1:
            raise PoiseError(
                "a policy teaches on its own body, and there are several shapes", code="single-body-only"
            )
        if env.goal.humanoid.identity != tracker.humanoid.identity:
            raise PoiseError(
                "the policy that teaches has another body",
                hint="Bring the clips onto its",
                code="bodies-differ",
            )
        task = stage_task(replace(tracker.config, help_start=0.0), env.goal.humanoid, None)
        # The same worlds, seen as the policy sees them.
        task = replace(task, rewards=(), dones=(), style=(), adaptive=0.0)
        self.env, self.policy = env, tracker.policy.copy().to(env.device)
        self._seen = ImitationEnv(env.goal, env.backend, task, env.substeps)

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for the worlds as they stand now; `obs` is not looked at."""
        env, seen, n = self.env, self._seen, self.env.hinges
        reference = env.reference
        now, ahead = (reference.hinges[reference.rows(env.clip, env.frame + k)].float() for k in (0, 1))
        seen.age.copy_(env.age)
        last = seen.task.pd.action(env.task.pd.target(env.action[:, :n], now), now)
        seen.action[:, :n] = torch.where(env.age[:, None] > 0, last, 0.0)
        action = self.policy.act(seen.observe())[:, :n]
        if seen.task.filter:
            kept = seen.task.filter * (env.age > 0).to(action).unsqueeze(1)
            keep_actions(action, seen.action[:, :n], kept, n)
        own = env.task.pd.action(seen.task.pd.target(action, ahead), ahead)
        return env.unfiltered(torch.nn.functional.pad(own, (0, env.num_actions - n)))


def taught_by(teacher: Perpetual, **changes: Any) -> Perpetual:
    """The settings of a policy that another teaches: the teacher's own but for `changes`. Where its goal
    is keypoints, its actions are absolute, and it keeps no filter that would delay them."""
    own: dict[str, Any] = {"expert": False, "help_start": 0.0, "teacher": None}
    if changes.get("goal") == "keypoints" and teacher.goal == "rotations":
        own |= {"action": "absolute", "filter": 0.0, "ppo": replace(teacher.ppo, std=STD)}
    return replace(teacher, **(own | changes))


def distilled(
    tracker: Tracker,
    imitation: Imitation,
    threads: int = 0,
    dumps: Path | None = None,
    tell: TrainingCallbacks | None = None,
    device: str = "cpu",
    worlds: int = CLONE_WORLDS,
    start: PolicyBundle | None = None,
) -> WarmStart:
    """A policy, and its critic, for `imitation` that does as a trained one does where it comes to.

    This is DAgger. A policy that is told places alone (PHC's second goal, s^g-kp) cannot add to angles
    that it does not know, and learns them slowly by its rewards. A policy that is told rotations says at
    once what to do in the same state.

    start: the policy that is taught, by default a new one; device, worlds: of the characters, of which
    there are no more than the settings name.
    """
    config: Perpetual = imitation.config
    stage = Stage("single", 2, mixed=config.recovery)
    own = staged(practised(imitation, stage), stage)
    frames = imitation.reference.length.cpu()
    worlds, ppo = min(config.num_envs, worlds), own.ppo()
    how = {"threads": threads, "dumps": dumps, "help_scale": 0.0, "device": device, "guard": False}
    env = own.env(worlds, **how)
    env.weights = odds(imitation, stage, (frames - 1).double(), own.reference.length)
    try:
        taught = clone(
            cast(VecEnv, env),
            PolicyTeacher(env, tracker),
            config.clone or clone_for(int(frames.sum()), worlds),
            replace(ppo, policy_hidden=config.single_hidden),
            config.seed,
            (tell or TrainingCallbacks()).round,
            start,
        )
    finally:
        env.close()
    return taught[0]
