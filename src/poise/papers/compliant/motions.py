"""The motions of scenes for which no clip comes along: made of key poses, as `poise complete` does.

The key poses are the policy's pose at ease, moved; the in-betweening network that comes with Poise makes
the steps between them, and a hand is led by inverse kinematics. No recording of a person is in them.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from poise.jobs.inbetween.fill import inbetween
from poise.jobs.tracker import Tracker
from poise.kin import match_positions, qpos_to_clip
from poise.kin.directed import end_of
from poise.motion import Clip
from poise.papers.compliant.hopping import AT_SOMEBODY, WAYS, hopping
from poise.papers.compliant.poses import at_ease, smooth_step
from poise.papers.compliant.scenes import Chicken, PlayScene, door

#: Where the hand takes the knob: m before the shoulder, to the middle from it, and above the floor.
REACH_M, INWARD_M, KNOB_M = 0.3, 0.03, 1.12


def motion_of(scene: PlayScene, tracker: Tracker, seconds: float = 8.0) -> Clip | None:
    """The motion of a scene that has one of its own, else None; a door takes its own time."""
    if isinstance(scene, Chicken):
        return hopping(tracker, seconds, ways=AT_SOMEBODY if scene.against == "rival" else WAYS)
    if isinstance(scene, door.Doorway):
        return opening(tracker, min(max(scene.made_for or scene.width, 0.5), 3.0))
    return None


def opening(tracker: Tracker, width: float = 1.0) -> Clip:
    """5 s: stand, take a knob with the left hand, open a door so many metres wide away from oneself, let
    go."""
    rate, ease = float(tracker.config.sim.control_hz), at_ease(tracker)
    frames = round(door.LASTS_S * rate) + 1
    t = np.arange(frames) / rate
    open_by = door.OPENS * smooth_step(t, door.GRIPS_S + 0.1, door.LETS_GO_S - 0.3)
    radius = door.Door(width=width).knob[1]
    # From where the knob is closed: x = r sin(phi), y = -r (1 - cos(phi)).
    knob = np.stack((radius * np.sin(open_by), -radius * (1.0 - np.cos(open_by)), 0.0 * t), 1)
    qpos = ease[None].repeat(frames, 0)
    qpos[:, :2] += knob[:, :2]
    clip = qpos_to_clip(qpos, tracker.humanoid.table, tracker.humanoid.skeleton, rate, name="opening")
    first, last = round((door.GRIPS_S + 0.1) * rate), round((door.LETS_GO_S - 0.1) * rate)
    clip = inbetween(clip, (first, last)).clip
    return _led(clip, _hand_path(clip, knob, t))


def _hand_path(clip: Clip, knob: np.ndarray, t: np.ndarray) -> Tensor:
    """`(T, 3)` where the left hand goes: hanging, to the knob, along with it, back."""
    hand = clip.positions()[:, end_of(clip.skeleton, "left_hand")]
    shoulder = clip.positions()[0, clip.skeleton.parents[_elbow(clip)]]
    there = np.array([shoulder[0] + REACH_M, shoulder[1] - INWARD_M, KNOB_M]) + knob
    share = smooth_step(t, 0.4, door.GRIPS_S - 0.2) - smooth_step(
        t, door.LETS_GO_S + 0.05, door.LASTS_S - 0.1
    )
    return torch.from_numpy(hand + share[:, None] * (there - hand))


def _elbow(clip: Clip) -> int:
    return clip.skeleton.parents[end_of(clip.skeleton, "left_hand")]


def _led(clip: Clip, goal: Tensor) -> Clip:
    root, rot = clip.tensors()
    led = match_positions(clip.skeleton, rot, root, {end_of(clip.skeleton, "left_hand"): goal})
    return clip.replaced(rot=led.numpy())
