"""A hopping motion made of key poses, for the chicken fight (Deep Compliant Control, Sec. 5.3)."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from poise.env import Reference
from poise.jobs.tracker import Tracker
from poise.kin import clip_to_qpos, match_positions, qpos_to_clip
from poise.kin.directed import end_of
from poise.motion import Clip
from poise.papers.compliant.poses import at_ease, smooth_step
from poise.spatial import quat_conj, quat_mul

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
        qpos = clip_to_qpos(clip.replaced(
            root_pos=clip.root_pos[frame : frame + 3], rot=clip.rot[frame : frame + 3]
        ), body.table)  # fmt: skip
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
    root, rot = clip.tensors()
    goals: dict[int | str, Tensor] = {right: torch.from_numpy(standing), left: torch.from_numpy(hanging)}
    bent = clip.replaced(rot=match_positions(clip.skeleton, rot, root, goals).numpy())
    # The sole stays level.
    world, level = torch.from_numpy(bent.world()[1]), torch.from_numpy(still.world()[1])
    rot = bent.tensors()[1].clone()
    rot[:, right] = quat_mul(quat_conj(world[:, clip.skeleton.parents[right]]), level[:, right])
    return bent.replaced(rot=rot.numpy())


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
