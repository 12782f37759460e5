"""Teaches a policy its own answers, averaged over noise on the velocities: it moves less roughly.

    python benchmarks/smoother.py --library FOLDER --from POLICY -o smoother.safetensors --minutes 8

The policy goes on where it leads itself, with noise on its actions, and is taught there, for a state s
in deviations of the observation and normal noise n on the goal's velocities less the character's, by
(a(s + n) + a(s - n)) / 2 of the policy that was given: its mean over n. Nothing is tried and rewarded,
so that it is quick, and nothing is won back that it costs; `tracker.py --from smoother.safetensors
--smooth 0.02` does that afterwards. FOLDER is that of `tracker.py`.
"""

from __future__ import annotations

import time
from dataclasses import replace

import torch
from torch import Tensor
from tracker import BACKWARDS, HELD_OUT, SIXTY, TWINS, parser_of

from poise.body import BodyConfig
from poise.env import ImitationEnv
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.jobs.perpetual.run import clips_of
from poise.jobs.tracker import Tracker, save_tracker
from poise.learn import PolicyBundle
from poise.recipes.perpetual import build

#: Control steps between lessons, and states of a minibatch.
STEPS, MINIBATCH = 16, 4096
#: Deviation of the actions' noise, rad, and Adam's step size, which falls to a tenth in the second half.
STD, RATE = 0.05, 1e-4


class Lessons:
    """What a pupil sees where it leads itself, and what its teacher answers there."""

    def __init__(
        self, env: ImitationEnv, pupil: PolicyBundle, teacher: PolicyBundle, noise: Tensor, seed: int
    ):
        """noise: `(O,)`, deviations of what is added to normalised observations."""
        self.env, self.pupil, self.teacher, self.noise = env, pupil, teacher, noise
        self.rng = torch.Generator().manual_seed(seed)
        self.obs = env.reset().clone()

    @torch.no_grad()
    def states(self) -> Tensor:
        """Normalised observations of the next steps, in a random order."""
        seen: list[Tensor] = []
        for _ in range(STEPS):
            seen.append(self.pupil.norm.forward(self.obs).clone())
            action = self.pupil.policy.act(seen[-1])
            action = action + STD * torch.randn(action.shape, generator=self.rng)
            self.obs = self.env.step(action).obs.clone()
        states = torch.cat(seen)
        return states[torch.randperm(len(states), generator=self.rng)]

    @torch.no_grad()
    def answers(self, states: Tensor) -> Tensor:
        moves = self.noise * torch.randn(states.shape, generator=self.rng)
        ahead, back = (self.teacher.policy.act(states + s * moves) for s in (1.0, -1.0))
        return (ahead + back) / 2


def smoothed(
    tracker: Tracker, env: ImitationEnv, noise: Tensor, minutes: float, seed: int
) -> PolicyBundle:
    """The policy after so many minutes of lessons by itself."""
    pupil, begun = tracker.policy.copy(), time.monotonic()
    lessons = Lessons(env, pupil, tracker.policy, noise, seed)
    params = list(pupil.policy.mean.parameters())
    for param in params:
        param.requires_grad_(True)
    optimizer, count = torch.optim.Adam(params, lr=RATE), 0
    while (left := 1.0 - (time.monotonic() - begun) / (60.0 * minutes)) > 0:
        optimizer.param_groups[0]["lr"] = RATE * min(1.0, max(2.0 * left, 0.1))
        losses: list[float] = []
        for states in lessons.states().split(MINIBATCH):
            off = pupil.policy.mean(states) - lessons.answers(states)
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
    return pupil


def main() -> None:
    parser = parser_of(__doc__ or "", minutes=8.0)
    parser.add_argument("--from", dest="earlier", required=True, help="the policy")
    parser.add_argument("--noise", type=float, default=0.8, help="in deviations of the observation")
    parser.add_argument("--worlds", type=int, default=2048, help="characters at once")
    a = parser.parse_args()
    torch.set_num_threads(a.threads or 1)
    tracker = open_run(a.earlier).tracker
    how = LibraryConfig(rates=SIXTY, mirror=True, backwards=BACKWARDS)
    library, _ = clips_of(a.library, BodyConfig(), HELD_OUT, TWINS, print, tracker.target, how)
    task = build(library, tracker.config, tracker.target.table, tracker.recovery_clips)
    env = task.env(a.worlds, a.seed, threads=a.threads or 1, help_scale=0.0, guard=False)
    assert task.task.velocities is not None
    noise = torch.zeros(env.num_obs)
    noise[slice(*task.task.velocities)] = a.noise
    try:
        policy = smoothed(tracker, env, noise, a.minutes, a.seed)
    finally:
        env.close()
    save_tracker(replace(tracker, policy=policy), a.out)


if __name__ == "__main__":
    main()
