"""The motions of scenes for which no clip comes along: made of key poses, standing, hopping.

The key poses are the policy's pose at ease, moved. The in-betweening network that comes with Poise makes
the steps between them, and inverse kinematics leads a hand. No recording of a person is in them.
"""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from dataclasses import replace

import numpy as np

from poise.env import Reference
from poise.errors import PoiseError
from poise.jobs.inbetween.fill import inbetween
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.kinematics import clip_to_qpos, match_positions, qpos_to_clip
from poise.kinematics.directed import end_of
from poise.motion import Clip, ClipLibrary
from poise.motion.rotations import quat_conj, quat_mul
from poise.papers.compliant.scenes import Chicken, PlayScene, door
from poise.recipes.imitation import Imitation


def at_ease(tracker: Tracker, yaw: float = 0.0) -> np.ndarray:
    """`(7 + n,)` the policy's pose at ease, above the origin, facing +X turned by `yaw` rad.

    Raises:
        PoiseError: the policy has not learned to stand at ease, which policies with recovery have.
    """
    if tracker.recovery_clips is None:
        raise PoiseError(
            "the policy knows no pose at ease",
            hint="Give a policy that was trained with recovery",
            code="no-pose-at-ease",
        )
    qpos = tracker.recovery_clips.ease.double().numpy().copy()
    clip = qpos_to_clip(np.stack([qpos, qpos]), tracker.humanoid.table, tracker.humanoid.skeleton, 30.0)
    left, right = (clip.positions()[0, end_of(clip.skeleton, f"{s}_foot")] for s in ("left", "right"))
    hips = _hips(tracker, clip)
    side = hips if hips is not None else left - right
    turn = yaw + np.pi / 2 - np.arctan2(side[1], side[0])
    about = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)], dtype=float)
    qpos[3:7] = quat_mul(about, qpos[3:7])
    qpos[:2] = 0.0
    return qpos


def _hips(tracker: Tracker, clip: Clip) -> np.ndarray | None:
    """From the right hip to the left one."""
    rows = tracker.humanoid.table.rows
    by = {rows[i].side: rows[i].joint for i in tracker.humanoid.rows_of("thigh")}
    if not {"left", "right"} <= by.keys():
        return None
    pos = clip.positions()[0]
    return pos[by["left"]] - pos[by["right"]]


def smooth_step(t: np.ndarray, start: float, stop: float) -> np.ndarray:
    """0 before `start`, 1 after `stop`, s, smooth between them."""
    x = np.clip((t - start) / (stop - start), 0.0, 1.0)
    return x * x * x * (10.0 + x * (6.0 * x - 15.0))


#: s: a foot is lifted, then the first hop begins; of each hop on the ground, and in the air.
LIFTS_S, BEGINS_S, STANDS_S, FLIES_S = (0.3, 1.0), 1.5, 4 / 15, 2 / 15
#: m: of a hop along the ground; how far the knee is bent; where the lifted foot is, back and up.
STRIDE_M, BENT_M, BACK_M, UP_M = 0.05, 0.03, 0.22, 0.24
#: Where the hops go to, one after the other: ahead, to the left, back, to the right; or at somebody.
Ways = tuple[tuple[int, int], ...]
AT_SOMEBODY: Ways = ((1, 0), (1, 0), (1, 0), (-1, 0))
WAYS: Ways = ((1, 0), (1, 0), (0, 1), (0, 1), (-1, 0), (-1, 0), (0, -1), (0, -1))
G = 9.81


def hopping(tracker: Tracker, seconds: float = 8.0, yaw: float = 0.0, ways: Ways = WAYS) -> Clip:
    """Hops on the right foot, by default in all directions and in place on the whole; the motion faces
    +X turned by `yaw`.

    Key poses are the pose at ease with a foot lifted, at take-off, at the top and at landing; the pelvis
    goes by the parabola in the air and by half a sine on the ground, with the same speed at both ends;
    the legs are led by inverse kinematics. The centre of mass is above the ankle that carries it.
    """
    ease = at_ease(tracker, yaw)
    body = tracker.humanoid
    foot = next(i for i in body.feet if body.table.rows[i].side == "right")
    # Once above the ankle with the pelvis, then with the centre of mass.
    off = np.zeros(3)
    for _ in range(2):
        # The clip itself may end before the foot is lifted.
        clip = _hopping(tracker, ease, LIFTS_S[1] + 0.5, yaw, off, ways)
        frame = round(LIFTS_S[1] * clip.fps)
        qpos = clip_to_qpos(
            clip.replaced(root_pos=clip.root_pos[frame : frame + 3], rot=clip.rot[frame : frame + 3]),
            body.table,
        )
        pose = Reference(body, [qpos], clip.fps, [clip.name]).pose
        off[:2] -= (pose.com[0] - pose.pos[0, foot])[:2].numpy()
    return _hopping(tracker, ease, seconds, yaw, off, ways)


def _hopping(
    tracker: Tracker, ease: np.ndarray, seconds: float, yaw: float, off: np.ndarray, ways: Ways
) -> Clip:
    """off: m, the pelvis from above the ankle while one foot stands."""
    rate, body = float(tracker.config.sim.control_hz), tracker.humanoid
    t = np.arange(round(seconds * rate) + 1) / rate
    still = qpos_to_clip(ease[None].repeat(len(t), 0), body.table, body.skeleton, rate, name="hopping")
    right, left = (end_of(still.skeleton, f"{side}_foot") for side in ("right", "left"))
    feet = still.positions()[0]
    lift = smooth_step(t, *LIFTS_S)[:, None]
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    along, height, air = hops(t, ways)
    along = along @ turn.T
    over = (feet[right] - ease[:3]) * [1.0, 1.0, 0.0] + off
    moved = lift * (over - [0.0, 0.0, BENT_M]) + along
    moved[:, 2] += height
    standing = feet[right] + along
    standing[:, 2] += air
    lifted = turn @ np.array([-BACK_M, 0.0, UP_M])
    hanging = feet[left] + lift * (lifted + 0.6 * over) + along
    hanging[:, 2] += height
    clip = still.replaced(root_pos=still.root_pos + moved)
    root, rot = clip.arrays()
    goals: dict[int | str, np.ndarray] = {right: standing, left: hanging}
    bent = clip.replaced(rot=match_positions(clip.skeleton, rot, root, goals))
    # The sole stays level.
    world, level = bent.world()[1], still.world()[1]
    rot = bent.rot.copy()
    rot[:, right] = quat_mul(quat_conj(world[:, clip.skeleton.parents[right]]), level[:, right])
    return bent.replaced(rot=rot)


def hops(t: np.ndarray, ways: Ways = WAYS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At times `t (T,)` s: the way along the ground `(T, 3)`, the pelvis' height and the foot's `(T,)`,
    m."""
    cycle = STANDS_S + FLIES_S
    since = np.maximum(t - BEGINS_S, 0.0)
    count, phase = np.floor(since / cycle).astype(int), since % cycle
    speed = 0.5 * G * FLIES_S
    flown = phase - STANDS_S
    # z = v s - g s^2 / 2 in the air; on the ground half a sine that begins and ends with -v and v.
    up = speed * flown - 0.5 * G * flown**2
    down = -speed * STANDS_S / np.pi * np.sin(np.pi * phase / STANDS_S)
    flies = (flown > 0.0) & (t > BEGINS_S)
    # The first one begins at rest: its dip is a whole cosine's first half.
    first = (count == 0) & (phase <= STANDS_S)
    height = np.where(flies, up, np.where(first, down * np.sin(0.5 * np.pi * phase / STANDS_S), down))
    goes = STRIDE_M * np.array([ways[k % len(ways)] for k in range(int(count.max()) + 1)], dtype=float)
    before = np.concatenate((np.zeros((1, 2)), np.cumsum(goes, 0)))
    share = np.where(flies, smooth_step(flown, 0.0, FLIES_S), 0.0)
    flat = before[count] + share[:, None] * goes[count]
    along = np.concatenate((flat, np.zeros((len(t), 1))), 1)
    return along, height * (t > BEGINS_S), np.where(flies, up, 0.0)


#: Where the hand takes the knob: m before the shoulder, to the middle from it, and above the floor.
REACH_M, INWARD_M, KNOB_M = 0.3, 0.03, 1.12


def motion_of(scene: PlayScene, tracker: Tracker, seconds: float = 8.0) -> Clip | None:
    """The motion of a scene that has one of its own, else None; a door takes its own time."""
    if isinstance(scene, Chicken):
        return hopping(tracker, seconds, ways=AT_SOMEBODY if scene.against == "rival" else WAYS)
    if isinstance(scene, door.DoorScene):
        return opening(tracker, min(max(scene.made_for or scene.width, 0.5), 3.0))
    return None


def opening(tracker: Tracker, width: float = 1.0) -> Clip:
    """5 s: stand, take a knob with the left hand, open a door so many metres wide away from oneself, let
    go."""
    rate, ease = float(tracker.config.sim.control_hz), at_ease(tracker)
    frames = round(door.LASTS_S * rate) + 1
    t = np.arange(frames) / rate
    opens_s = door.GRIPS_S + door.OPENING_S[0], door.LETS_GO_S - door.OPENING_S[1]
    open_by = door.OPENS * smooth_step(t, *opens_s)
    radius = door.Door(width=width).knob[1]
    # From where the knob is closed: x = r sin(phi), y = -r (1 - cos(phi)).
    knob = np.stack((radius * np.sin(open_by), -radius * (1.0 - np.cos(open_by)), 0.0 * t), 1)
    qpos = ease[None].repeat(frames, 0)
    qpos[:, :2] += knob[:, :2]
    clip = qpos_to_clip(qpos, tracker.humanoid.table, tracker.humanoid.skeleton, rate, name="opening")
    first, last = round((door.GRIPS_S + 0.1) * rate), round((door.LETS_GO_S - 0.1) * rate)
    clip = inbetween(clip, (first, last)).clip
    return _led(clip, _hand_path(clip, knob, t))


def _hand_path(clip: Clip, knob: np.ndarray, t: np.ndarray) -> np.ndarray:
    """`(T, 3)` where the left hand goes: hanging, to the knob, along with it, back."""
    hand = clip.positions()[:, end_of(clip.skeleton, "left_hand")]
    shoulder = clip.positions()[0, clip.skeleton.parents[_elbow(clip)]]
    there = np.array([shoulder[0] + REACH_M, shoulder[1] - INWARD_M, KNOB_M]) + knob
    share = smooth_step(t, 0.4, door.GRIPS_S - 0.2) - smooth_step(
        t, door.LETS_GO_S + 0.05, door.LASTS_S - 0.1
    )
    return hand + share[:, None] * (there - hand)


def _elbow(clip: Clip) -> int:
    return clip.skeleton.parents[end_of(clip.skeleton, "left_hand")]


def _led(clip: Clip, goal: np.ndarray) -> Clip:
    root, rot = clip.arrays()
    led = match_positions(clip.skeleton, rot, root, {end_of(clip.skeleton, "left_hand"): goal})
    return clip.replaced(rot=led)


def standing(tracker: Tracker, seconds: float) -> Imitation:
    """A task in which the policy's body stands at ease for so long.

    Raises:
        PoiseError: the policy has not learned to stand at ease, which policies with recovery have.
    """
    if tracker.recovery_clips is None:
        raise PoiseError(
            "the policy knows no pose at ease",
            hint="Give a policy that was trained with recovery",
            code="no-pose-at-ease",
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
