"""A motion that is lost and found again: the character gets up, comes back and goes on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from poise.env import Reference
from poise.env.goals.led import TRACKS, LedGoal
from poise.errors import PoiseError
from poise.jobs.track.placement import Placed
from poise.jobs.track.policy import Tracker
from poise.jobs.track.replay import Replay
from poise.kin import qpos_to_clip
from poise.motion import Clip, ClipLibrary, resample
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
    tracker: Tracker, placed: Placed, imitation: Imitation, threads: int
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
    env = replace(imitation, task=task).env(1, auto_reset=False, threads=threads, help_scale=0.0)
    zero = torch.zeros(1, dtype=torch.long)
    env.reset_to(zero, zero)
    goal = LedGoal(env.goal.clips, tracker.recovery_clips)
    obs = env.set_goal(goal)
    rate, last = env.reference.rate_hz, int(env.reference.length[0]) - 1
    frames, of, actions = [env.reference.coordinates(zero, zero)[0]], [0], []
    lost: list[float] = []
    back: list[float] = []
    try:
        while True:
            actions.append(tracker.policy.act(obs))
            now, here, frame = (len(frames) - 1) / rate, int(goal.doing) == TRACKS, int(goal.frame)
            if len(goal.lost) > len(lost):
                lost.append(now)
            if here and len(back) < len(lost):
                back.append(now)
            if len(lost) > LOSSES or (not here and now > lost[-1] + AWAY_S):
                break
            obs = env.step(actions[-1]).final_obs
            frames.append(goal.aimed())
            of.append(frame + 1 if here else frame)
            if here and frame + 1 >= last:
                break
    finally:
        env.close()
    if not lost:
        return None
    qpos, own = torch.cat(frames).cpu().numpy(), imitation.library.clips[0]
    body = imitation.humanoid
    clip = qpos_to_clip(qpos, body.table, own.skeleton, rate, _held(own, rate, of), own.name)
    source = resample(_held(placed.source, rate, of), placed.source.fps)
    placed = replace(placed, source=source, clip=resample(clip, own.fps), qpos=qpos)
    library = ClipLibrary((placed.clip,), (1.0,))
    reference = Reference(body, [qpos], rate, [own.name])
    out = replace(imitation, library=library, reference=reference)
    return placed, out, Replay(torch.cat(actions)), Losses(tuple(lost), tuple(back))


def _held(clip: Clip, rate: float, of: list[int]) -> Clip:
    """A clip's frames `of` at `rate`, one after another."""
    clip = resample(clip, rate)
    rows = np.minimum(of, clip.frames - 1)
    return clip.replaced(root_pos=clip.root_pos[rows], rot=clip.rot[rows])
