"""Teaches a policy its own answers, averaged over noise on the velocities: it moves less roughly.

    python training/smoother.py --library FOLDER --from POLICY -o smoother.safetensors --minutes 8

The policy goes on where it leads itself, with noise on its actions, and is taught there, for a state s
in deviations of the observation and normal noise n on the goal's velocities less the character's, by
(a(s + n) + a(s - n)) / 2 of the policy that was given: its mean over n. Nothing is tried and rewarded,
so that it is quick, and nothing is won back that it costs; `tracker.py --from smoother.safetensors
--smooth 0.02` does that afterwards. With `--also ANOTHER` clips of FOLDER, that of `tracker.py`, that
ANOTHER does and POLICY does not are 30 % of what is practised, and their lessons are ANOTHER's.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor
from tracker import BACKWARDS, HELD_OUT, SIXTY, TWINS, parser_of

from poise.body import BodyConfig
from poise.env import ImitationEnv
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.perpetual.perpetual_run import clips_of
from poise.jobs.tracker import save_tracker
from poise.learn import PolicyBundle
from poise.recipes.perpetual import build

#: Control steps between lessons, and states of a minibatch.
STEPS, MINIBATCH = 16, 4096
#: Deviation of the actions' noise, rad, and Adam's step size, which falls to a tenth in the second half.
STD, RATE = 0.05, 1e-4
#: Of the episodes, those on clips that another policy teaches.
SHARE = 0.3


class Lessons:
    """What a pupil sees where it leads itself, and what its teachers answer there.

    Args:
        teachers: of the clips for which `hard` `(C,)` is False, and where there is another, of the rest.
        noise: `(O,)`, deviations of what is added to normalised observations.
    """

    def __init__(
        self,
        env: ImitationEnv,
        pupil: PolicyBundle,
        teachers: Sequence[PolicyBundle],
        hard: Tensor,
        noise: Tensor,
        seed: int,
    ):
        self.env, self.pupil, self.teachers = env, pupil, teachers
        self.hard, self.noise = hard, noise
        self.rng = torch.Generator().manual_seed(seed)
        self.obs = env.reset().clone()

    @torch.no_grad()
    def states(self) -> tuple[Tensor, Tensor]:
        """Observations of the next steps in a random order, and which are of hard clips."""
        seen, hard = list[Tensor](), list[Tensor]()
        for _ in range(STEPS):
            seen.append(self.obs)
            hard.append(self.hard[self.env.clip])
            action = self.pupil.act(self.obs)
            action = action + STD * torch.randn(action.shape, generator=self.rng)
            self.obs = self.env.step(action).obs.clone()
        states = torch.cat(seen)
        order = torch.randperm(len(states), generator=self.rng)
        return states[order], torch.cat(hard)[order]

    @torch.no_grad()
    def answers(self, states: Tensor, hard: Tensor) -> Tensor:
        out = self._averages(self.teachers[0], states)
        if hard.any():
            out[hard] = self._averages(self.teachers[-1], states[hard])
        return out

    def _averages(self, teacher: PolicyBundle, states: Tensor) -> Tensor:
        seen = teacher.norm.forward(states)
        moves = self.noise * torch.randn(seen.shape, generator=self.rng)
        ahead, back = (teacher.policy.act(seen + s * moves) for s in (1.0, -1.0))
        return (ahead + back) / 2


def taught(lessons: Lessons, minutes: float) -> None:
    """Teaches the pupil for so many minutes."""
    pupil, env, begun = lessons.pupil, lessons.env, time.monotonic()
    params = list(pupil.policy.mean.parameters())
    for param in params:
        param.requires_grad_(True)
    optimizer, count = torch.optim.Adam(params, lr=RATE), 0
    while (left := 1.0 - (time.monotonic() - begun) / (60.0 * minutes)) > 0:
        optimizer.param_groups[0]["lr"] = RATE * min(1.0, max(2.0 * left, 0.1))
        losses: list[float] = []
        for states, hard in zip(*(x.split(MINIBATCH) for x in lessons.states()), strict=True):
            off = pupil.policy.mean(pupil.norm.forward(states)) - lessons.answers(states, hard)
            loss = (off / STD).square().sum(-1).mean() / 2
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(params, 5.0)
            optimizer.step()
            losses.append(float(loss.detach()))
        count += STEPS * env.num_envs
        print(
            f"{count:,} states, {60 * minutes * left:.0f} s left, loss {sum(losses) / len(losses):.3f}"
        )
    for param in params:
        param.requires_grad_(False)


def main() -> None:
    parser = parser_of(__doc__ or "", minutes=8.0)
    parser.add_argument("--from", dest="earlier", required=True, help="the policy")
    parser.add_argument("--also", type=Path, help="another policy, which teaches what it alone does")
    parser.add_argument("--noise", type=float, default=0.8, help="in deviations of the observation")
    parser.add_argument("--worlds", type=int, default=2048, help="characters at once")
    a = parser.parse_args()
    torch.set_num_threads(a.threads or 1)
    tracker = open_run(a.earlier).tracker
    how = LibraryConfig(rates=SIXTY, mirror=True, backwards=BACKWARDS)
    library, _ = clips_of(a.library, BodyConfig(), HELD_OUT, TWINS, print, tracker.target, how)
    task = build(library, tracker.config, tracker.target.table, tracker.recovery_clips)
    hard, teachers = torch.zeros(len(library), dtype=torch.bool), [tracker.policy]
    if a.also:
        teachers.append(open_run(a.also).tracker.policy)
        own, its = (evaluate_clips(task, t, threads=a.threads or 1).succeeded for t in teachers)
        hard = its & ~own
        print(f"{int(own.sum())} of {len(library)} clips done, {int(hard.sum())} more by the other")
    env = task.env(a.worlds, a.seed, threads=a.threads or 1, help_scale=0.0, guard=False)
    noise = torch.zeros(env.num_obs)
    for name in task.task.velocities:
        noise[env.columns[name]] = a.noise
    if hard.any():
        odds = env.weights
        env.weights = torch.where(hard, SHARE / odds[hard].sum(), (1 - SHARE) / odds[~hard].sum()) * odds
    pupil = tracker.policy.copy()
    try:
        taught(Lessons(env, pupil, teachers, hard, noise, a.seed), a.minutes)
    finally:
        env.close()
    save_tracker(replace(tracker, policy=pupil), a.out)


if __name__ == "__main__":
    main()
