"""What is done about a motion that is lost: it is looked for by many characters at once
(`plan.sampling`), or the character gets up, comes back and goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv, Reference
from poise.env.goals.led import TRACKS, LedGoal
from poise.errors import PoiseError
from poise.eval import simulate
from poise.jobs.track.placement import Placed
from poise.jobs.tracker import Tracker
from poise.kin import qpos_to_clip
from poise.motion import Clip, ClipLibrary, resample
from poise.plan import SamplingConfig, SamplingControl, SamplingResult
from poise.recipes.imitation import Imitation

#: A motion that is lost more often is given up, and so is one that the character has left for so many s.
LOSSES, AWAY_S = 8, 30.0


@dataclass(frozen=True)
class Losses:
    """When a motion was lost and when it was found again, s of what comes out; `back` is shorter by one
    where it was given up."""

    lost: tuple[float, ...]
    back: tuple[float, ...]

    def sentence(self) -> str:
        """What became of the motion."""
        times = "once" if len(self.lost) == 1 else f"{len(self.lost)} times"
        said = f"The character lost the motion {times}, first at {self.lost[0]:.1f} s,"
        if len(self.back) < len(self.lost):
            last = f"the loss at {self.lost[-1]:.1f} s"
            return f"{said} and did not come back after {last}; the result ends where it was given up."
        away = sum(self.back) - sum(self.lost)
        return f"{said} and came back; the motion waited for it, and is {away:.1f} s longer in all."


def with_returns(
    tracker: Tracker, placed: Placed, imitation: Imitation
) -> tuple[Placed, Imitation, Replay, Losses] | None:
    """Tracks a motion, and a recovery motion wherever it is lost; None where it never is.

    Returns:
        the motion with the recovery motions in it, as it was tracked, also as a task of its own; the
        actions that track it; and when it was lost.

    Raises:
        PoiseError: the policy has not learned to come back.
    """
    if tracker.recovery_clips is None:
        raise PoiseError(
            "the policy has not learned to come back",
            hint="Leave --recover out, or train one on a library with a clip that gets up",
        )
    task = replace(imitation.task, help_by="all")
    env = replace(imitation, task=task).env(1, auto_reset=False, threads=1, help_scale=0.0)
    try:
        zero = torch.zeros(1, dtype=torch.long)
        env.reset_to(zero, zero)
        goal = LedGoal(env.goal.clips, tracker.recovery_clips)
        led = _Led(goal, env.reference.coordinates(zero, zero)[0])
        most = led.last + int((LOSSES + 1) * AWAY_S * led.rate)
        simulate(env, tracker.policy, env.set_goal(goal), most, led)
    finally:
        env.close()
    if not led.lost:
        return None
    qpos, own = torch.cat(led.frames).cpu().numpy(), imitation.library.clips[0]
    body, rate, of = imitation.humanoid, led.rate, led.of
    clip = qpos_to_clip(qpos, body.table, own.skeleton, rate, _held(own, rate, of), own.name)
    source = resample(_held(placed.source, rate, of), placed.source.fps)
    placed = replace(placed, source=source, clip=resample(clip, own.fps), qpos=qpos)
    library = ClipLibrary((placed.clip,), (1.0,))
    reference = Reference(body, [qpos], rate, [own.name])
    out = replace(imitation, library=library, reference=reference)
    return placed, out, Replay(torch.cat(led.actions)), Losses(tuple(led.lost), tuple(led.back))


class _Led:
    """Observes one character that is led back to its motion.

    Attributes:
        frames: coordinates `(1, 7 + n)` that it aimed at, one after another, `start` first.
        of: the frame of its motion that each of them is of.
        actions: `(1, A)` each.
        lost, back: when it lost the motion and found it again, s.
    """

    def __init__(self, goal: LedGoal, start: Tensor):
        self.goal, self.rate, self.last = goal, goal.rate_hz, int(goal.reference.length[0]) - 1
        self.frames, self.of, self.actions = [start], [0], list[Tensor]()
        self.lost, self.back = list[float](), list[float]()
        # Whether it is on its motion, and at which frame of it, before the next step.
        self._here, self._frame = True, 0

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps what the step aimed at; True: the motion is over, or given up."""
        if step:
            self.actions.append(env.action.clone())
            self.frames.append(self.goal.aimed())
            self.of.append(self._frame + 1 if self._here else self._frame)
            if self._here and self._frame + 1 >= self.last:
                return True
        now = step / self.rate
        self._here, self._frame = int(self.goal.doing) == TRACKS, int(self.goal.frame)
        if len(self.goal.lost) > len(self.lost):
            self.lost.append(now)
        if self._here and len(self.back) < len(self.lost):
            self.back.append(now)
        return len(self.lost) > LOSSES or (not self._here and now > self.lost[-1] + AWAY_S)


def _held(clip: Clip, rate: float, of: list[int]) -> Clip:
    """A clip's frames `of` at `rate`, one after another."""
    clip = resample(clip, rate)
    rows = np.minimum(of, clip.frames - 1)
    return clip.replaced(root_pos=clip.root_pos[rows], rot=clip.rot[rows])


def look_for(
    tracker: Tracker,
    imitation: Imitation,
    config: SamplingConfig,
    clip: int = 0,
    threads: int = 0,
    show: Callable[[int, int], None] | None = None,
) -> SamplingResult:
    """Looks for one of a task's motions with the tracker's policy, without help.

    threads: of the physics; 0 is all cores. show: is told of the control steps done and of all of them.
    """
    # Worlds that lose the motion may go bad; they are left behind.
    env = imitation.bare(rewards=True).env(
        config.characters, auto_reset=False, threads=threads, help_scale=0.0, guard=False
    )
    try:
        return SamplingControl(env, tracker.policy, config, tracker.value, clip).run(show)
    finally:
        env.close()


def sentence(found: SamplingResult, config: SamplingConfig, rate_hz: float) -> str:
    """What the search came to."""
    much = f"{config.characters} characters looked for it, {found.tries:,} control steps, without help"
    if found.whole:
        return f"The motion was lost; {much}, and found it to its end."
    at = found.reached / rate_hz
    return f"The motion was lost; {much}, and came as far as {at:.1f} s."


def replay(found: SamplingResult, policy: Acts) -> Replay:
    """Does what was found, and from where it was lost what the policy does."""
    return Replay(found.actions[: found.reached].clone(), policy)


@dataclass(eq=False)
class Replay:
    """Actions `(T, A)` one after another, for the one character that they were made for; after them
    acts the policy, if there is one."""

    actions: Tensor
    policy: Acts | None = None
    step: int = 0

    def act(self, obs: Tensor) -> Tensor:
        """The next one, `(1, A)`; `obs` is looked at by the policy alone."""
        at, self.step = self.step, self.step + 1
        if at >= len(self.actions) and self.policy is not None:
            return self.policy.act(obs)
        return self.actions[at : at + 1]
