"""A character that stands still, as a task of the policy that tracks any motion."""

from __future__ import annotations

from dataclasses import replace

from poise.env import Reference
from poise.errors import PoiseError
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.kin import qpos_to_clip
from poise.motion import ClipLibrary
from poise.recipes.imitation import Imitation


def standing(tracker: Tracker, seconds: float) -> Imitation:
    """A task in which the policy's body stands at ease for so long.

    Raises:
        PoiseError: the policy has not learned to stand at ease, which policies with recovery have.
    """
    if tracker.recovery_clips is None:
        raise PoiseError(
            "the policy knows no pose at ease", hint="Give a policy that was trained with recovery"
        )
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    ease = tracker.recovery_clips.ease.double().numpy()
    rate = tracker.config.sim.control_hz
    frames = max(2, round(seconds * rate) + 1)
    qpos, body = ease[None].repeat(frames, 0), task.humanoid
    clip = qpos_to_clip(qpos, body.table, body.skeleton, rate, name="standing")
    still = Reference(body, [qpos], rate, [clip.name])
    fit = replace(task.report.clips[0], name=clip.name)
    report = replace(task.report, clips=(fit,))
    return replace(task, library=ClipLibrary.of(clip), reference=still, report=report)
