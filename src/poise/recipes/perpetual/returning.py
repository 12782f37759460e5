"""How coming back is learned: a tracker learns ways back, and recovery learns from it blindfolded.

    ways of the library -> demonstrations -> a tracker of them -> the recovery primitive, cloned from it

The tracker sees each demonstration's next frame; of the same states the recovery primitive is told where
the demonstration ends, as a point goal (PHC Eq. 3), and has no other reference. It is taught by the
tracker where it goes itself (DAgger), and learns on by Eq. 4 from there.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from poise.env import ImitationEnv, Recovery, Reference
from poise.env.falls import fall_states, rest_angles
from poise.env.frame import Frame
from poise.env.recovery import point_goal, toward
from poise.env.rising import Rising
from poise.env.task import EnvStep
from poise.env.terms.evaluate import seen_by
from poise.env.way_back import names_of, return_motions
from poise.env.ways import find_ways
from poise.learn import PolicyBundle, Trainer, VecEnv, WarmStart, clone
from poise.recipes.expert import CLONE_WORLDS, Beginning, finetuning
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual
from poise.recipes.perpetual.recovery import standing, walking_clips
from poise.recipes.perpetual.task import stage_task
from poise.sim import make_backend

#: The file of a run folder with the tracker of ways back, as far as it is trained.
WAYS = "ways.safetensors"
#: m: demonstrations begin no farther away.
FAR = 5.0
#: s between two checkpoints.
SAVE_S = 30.0


#: Whether so many control steps and seconds of the whole training are enough.
Enough = Callable[[int, float], bool]


def never(samples: int, seconds: float) -> bool:
    """Nothing is."""
    return False


def learn_returning(
    start: WarmStart,
    pupil: PolicyBundle,
    imitation: Imitation,
    folder: Path,
    threads: int,
    tell: Beginning,
    enough: Enough = never,
) -> WarmStart:
    """The recovery primitive: `pupil`, taught ways back, or `start` where the library knows none.

    start: what tracks already, which becomes the tracker of ways. imitation: with the task of the
    recovery primitive. folder: of the run, where the tracker is kept, so that a killed run goes on with
    it. enough: whether so many control steps and seconds are all that ways are worth; `way_samples` are
    in any case.
    """
    config: Perpetual = imitation.config
    ways = demonstrations(imitation)
    if ways is None:
        return start
    tracker = _track(start, ways, folder, threads, tell, enough)
    env = ways.env(min(config.num_envs, CLONE_WORLDS), threads=threads)
    env.help.set(0.0)
    env.weights = ways.reference.length.double()
    assert imitation.task.recovery is not None
    blind = Blindfold(env, imitation.task.recovery)
    try:
        how = config.recovering.taught, imitation.ppo(), config.seed, tell.round, pupil
        taught, _ = clone(cast(VecEnv, blind), Guide(blind, tracker.policy), *how)
    finally:
        blind.close()
    cost = {"samples": tracker.samples + taught.samples, "seconds": tracker.seconds + taught.seconds}
    return replace(start, policy=taught.policy, **cost)


def demonstrations(imitation: Imitation) -> Imitation | None:
    """The task of tracking demonstrations of coming back; None where there are none."""
    config: Perpetual = imitation.config
    plan, reference, humanoid = config.recovering, imitation.reference, imitation.humanoid
    if not plan.ways or len(reference.bodies) > 1:
        return None
    found = find_ways(reference, standing(reference), walking_clips(reference))
    if found is None:
        return None
    assert imitation.task.recovery is not None
    backend = make_backend(humanoid.model, min(256, plan.ways), "cpu", threads=1)
    try:
        drop = replace(imitation.task.recovery.drop, count=plan.ways)
        falls = fall_states(backend, humanoid, imitation.task.pd, drop, int(config.seed))
    finally:
        backend.close()
    rate = reference.rate_hz
    rising = Rising(found, humanoid.table, rate)
    motions = return_motions(rising, falls, FAR, plan.ways, int(config.seed))
    task = replace(stage_task(config, humanoid, None), help=None)
    shown = Reference(humanoid, motions, rate, names_of(plan.ways))
    return replace(imitation, reference=shown, task=task)


def _track(
    start: WarmStart, ways: Imitation, folder: Path, threads: int, tell: Beginning, enough: Enough
) -> WarmStart:
    """A tracker of the demonstrations that begins as the primitive; goes on with that of the folder."""
    config: Perpetual = ways.config
    trainer: Trainer = ways.trainer(
        threads, warm_start=replace(start, critic=None), ppo=finetuning(ways.ppo())
    )
    env, path = cast(ImitationEnv, trainer.env), folder / WAYS
    env.help.set(0.0)
    env.weights = ways.reference.length.double()
    try:
        if path.exists():
            trainer.load(path)
        until, saved = start.samples + config.recovering.way_samples, time.monotonic()
        done = trainer.samples >= until or enough(trainer.samples, trainer.seconds)
        while not done:
            stats = trainer.iterate()
            done = trainer.samples >= until or enough(trainer.samples, trainer.seconds)
            if done or time.monotonic() - saved > SAVE_S:
                folder.mkdir(parents=True, exist_ok=True)
                trainer.save(path)
                saved = time.monotonic()
            if tell.way is not None:
                tell.way(stats, until)
        return WarmStart(trainer.policy(), None, trainer.samples, trainer.seconds)
    finally:
        trainer.env.close()


class Blindfold:
    """Demonstrations as who recovers sees them: all that is known of a way back is where it ends.

    A `VecEnv` around an environment whose reference is demonstrations, without recovery. Actions are
    those of a task with recovery: where the goal is a point they add to the body at rest, near the end
    to the last frame.

    tracked: `(N, O)`, what who sees the way observes. goal: what is learned sees `task`'s terms.
    """

    def __init__(self, env: ImitationEnv, recovery: Recovery):
        self.env, self.recovery = env, recovery
        self.num_envs, self.num_actions, self.device = env.num_envs, env.num_actions, env.device
        self.num_obs = env.num_obs
        self._rest = rest_angles(env.reference.humanoid).float().to(env.device)
        self._last = env.reference.length.to(env.device) - 1
        self.tracked = env.reset()
        self._base = torch.zeros(env.num_envs, env.hinges, device=env.device)

    def reset(self) -> Tensor:
        """New episodes everywhere."""
        self.tracked = self.env.reset()
        return self._seen()

    def step(self, actions: Tensor) -> EnvStep:
        """One control step; `actions (N, A)` as in a task with recovery."""
        step = self.env.step(self.shifted(actions, -1.0))
        self.tracked = step.obs
        obs = self._seen()
        return step._replace(obs=obs, final_obs=obs)

    def shifted(self, actions: Tensor, sign: float = 1.0) -> Tensor:
        """Actions of who sees the way as actions of who does not; the other way round by sign -1."""
        pd, out = self.env.task.pd, actions.clone()
        if pd.mode == "additive":
            apart = (self.env.next_hinges() - self._base) / pd.scale
            out[:, : self.env.hinges] += sign * apart.to(out)
        return out

    def _seen(self) -> Tensor:
        """`(N, O)` observations, with the end of each demonstration as the goal."""
        env, c = self.env, self.recovery
        frame: Frame = env.frame_now()
        end = env.reference.gather(env.clip, self._last[env.clip])
        point = point_goal(frame.sim, end, frame.phase, c.switch)
        self._base = torch.where(point.far.unsqueeze(-1), self._rest, end.qpos[:, 7:])
        goal = toward(frame.sim, end, point.far, c.reach)
        return seen_by(env.observed, replace(frame, ahead=goal)).clone()

    def state(self) -> dict[str, Tensor]:
        """That of the environment."""
        return self.env.state()

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Goes on from `state()`."""
        self.env.load_state(state)

    def close(self) -> None:
        """Frees the worlds."""
        self.env.close()


@dataclass(frozen=True, eq=False)
class Guide:
    """Acts as the tracker of demonstrations, in the actions of who does not see them."""

    env: Blindfold
    policy: PolicyBundle

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """`(N, A)`; `obs` is not looked at."""
        return self.env.shifted(self.policy.act(self.env.tracked))
