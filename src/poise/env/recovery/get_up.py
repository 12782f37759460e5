"""From lying to standing: by which of a library's clips, and from which of its frames on."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import torch
from torch import Tensor

from poise.body import BodyTable
from poise.env.recovery.clips import CALM, RecoveryClips
from poise.kin import Kinematics, lowest_height
from poise.spatial import quat_distance, quat_mul, quat_rotate, slerp
from poise.spatial.directions import turned, yaw_quat

#: s that a blend takes, and m of the distance between poses that are blended in a second more.
BLEND_S, BLEND_SPEED = 0.4, 1.5
#: m: poses that are no farther apart are the same.
SAME = 0.01
#: m: a blend is lifted no higher than this for a limb that would reach into the floor.
LIFT = 0.12
#: m that a rad of the bodies' rotations counts, and a s that is up later, where poses are compared.
TURNED, LATER = 0.3, 0.1
#: Share of the standing height: where the root is no higher than this above its lowest, the body lies.
ENTERS = 0.1
#: Share of the root's height at ease; a character with its root below must get up.
DOWN = 0.6


class GetUpPlanner:
    """How the characters of a library get up from anywhere.

    Of all clips that get up, the one is taken that has the frame nearest to how the character lies, from
    there on. A library needs one from the back and one from the belly.
    """

    def __init__(self, recovery_clips: RecoveryClips, table: BodyTable, rate_hz: float):
        self.recovery_clips, self.table, self.rate_hz = recovery_clips, table, rate_hz
        pace = recovery_clips.pace
        self.ups = [
            _sooner(clip, max(pace.up, (len(clip) - 1) / (pace.up_s * rate_hz)))
            for clip in recovery_clips.ups
        ]
        self.kinematics = Kinematics(table)
        self._ups = [self.poses(clip) for clip in self.ups]
        # A clip is entered while its root lies: what comes later needs what came before.
        for up in self._ups:
            height = up.pos[:, 0, 2]
            up.keep(height <= height.min() + ENTERS * float(recovery_clips.ease[2]))

    def walks_calmly(self) -> GetUpPlanner:
        """The same, but that it walks and turns at the pace `CALM`, for one that lost nothing."""
        calm, clips = copy(self), self.recovery_clips
        pace = clips.pace._replace(walk=CALM.walk, turn=CALM.turn)
        calm.recovery_clips = replace(clips, pace=pace)
        return calm

    def lies(self, qpos: Tensor) -> Tensor:
        """`(...)` bool, which of the characters at `qpos (..., 7 + n)` must get up."""
        return qpos[..., 2] < DOWN * float(self.recovery_clips.ease[2])

    def up(self, start: Tensor, again: int = 0) -> Tensor:
        """`(T, 7 + n)` from lying at `start (7 + n)` to the end of a clip that gets up.

        again: how often that was lost in a row. What was lost is tried half as fast at its begin, and
            then by the clip that is next nearest: the same would be lost the same way for ever.
        """
        lying, clips = self.poses(start[None]), self.ups
        costs = [
            # Of two frames alike the later one is up sooner.
            lying.apart(up)[0] + LATER * (len(clip) - up.rows) / self.rate_hz
            for up, clip in zip(self._ups, clips, strict=True)
        ]
        nearest = sorted(range(len(clips)), key=lambda k: float(costs[k].min()))
        which, slower = nearest[again // 2 % len(clips)], 1 + again % 2
        entry = int(self._ups[which].rows[int(costs[which].argmin())])
        clip = self._laid(start, clips[which][entry:])
        return torch.cat((self._lifted(self.blend(start, clip[0], slower))[:-1], clip))

    def blend(self, a: Tensor, b: Tensor, slower: int = 1) -> Tensor:
        """`(T, 7 + n)` from one pose to another, the longer the farther they are apart.

        slower: factor of the time that it takes.
        """
        frames = self.out_of(a, b.expand(self._between(a, b), -1))
        return frames if slower == 1 else _sooner(frames, 1.0 / slower)

    def out_of(self, pose: Tensor, frames: Tensor, moves: Tensor | None = None) -> Tensor:
        """Frames of which the first ones come out of a pose, more of them the farther it is apart.

        moves: m/s `(2)` with which the pose goes on meanwhile.
        """
        count = self._between(pose, frames[0])
        if count == 1:
            return frames
        first = frames[:count]
        step = torch.arange(len(first), dtype=torch.float64)
        left = pose.repeat(len(first), 1)
        if moves is not None:
            left[:, :2] += moves * step[:, None] / self.rate_hz
        return torch.cat((mixed(left, first, smooth(step / (count - 1))), frames[count:]))

    def _between(self, a: Tensor, b: Tensor) -> int:
        """Frames from one pose to another; 1 where they are the same."""
        both = self.poses(torch.stack((a, b)))
        gap = float(both.row(0).apart(both.row(1)))
        gap = max(gap, float((b[:2] - a[:2]).norm()))
        return round(self.rate_hz * (BLEND_S + gap / BLEND_SPEED)) + 1 if gap > SAME else 1

    def _lifted(self, frames: Tensor) -> Tensor:
        """Frames raised or lowered until they touch the floor, by no more than `LIFT` m up."""
        body, out = self.kinematics(frames), frames.clone()
        lift = -lowest_height(self.table, body.pos, body.quat).amin(-1)
        out[:, 2] += lift.clamp(max=LIFT)
        return out

    def _laid(self, onto: Tensor, frames: Tensor) -> Tensor:
        """Frames moved and turned so that the first lies on the pose `onto`."""
        both = self.poses(torch.stack((frames[0], onto)))
        own, there = both.row(0), both.row(1)
        return turned(frames, float(there.turn(own)), own.centre[0], there.centre[0])

    def poses(self, qpos: Tensor) -> Poses:
        """Poses `(P, 7 + n)` of the characters, to be compared."""
        return Poses(self.kinematics, qpos)


class Poses:
    """Poses that are compared, wherever they stand and whichever way they face.

    Args:
        kinematics: of the body.
        qpos: `(P, 7 + n)`.
    """

    def __init__(self, kinematics: Kinematics, qpos: Tensor):
        body = kinematics(qpos)
        self.quat, self.centre = body.quat, body.pos[..., :2].mean(1)
        self.pos, self.rows = body.pos.clone(), torch.arange(len(qpos))
        self.pos[..., :2] -= self.centre.unsqueeze(1)

    def keep(self, those: Tensor) -> None:
        """Only some rows, `(P,)` bool; `rows` says which of all they are."""
        for name in ("pos", "quat", "centre", "rows"):
            setattr(self, name, getattr(self, name)[those])

    def row(self, k: int) -> Poses:
        """Pose k alone."""
        out = copy(self)
        out.keep(self.rows == k)
        return out

    def turn(self, other: Poses) -> Tensor:
        """`(P, Q)` rad about Z that lay each pose of `other` best on each of these."""
        p, q = self.pos[:, None, :, :2], other.pos[None, :, :, :2]
        cross = (q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]).sum(-1)
        return torch.atan2(cross, (p * q).sum((-1, -2)))

    def apart(self, other: Poses) -> Tensor:
        """`(P, Q)` m: how far bodies are apart and, `TURNED` m for a rad, how they are turned."""
        turn = self.turn(other)
        out = torch.empty_like(turn)
        # Row by row, since all pairs of all bodies are many.
        for i, angles in enumerate(turn):
            yaw = yaw_quat(angles).unsqueeze(1).expand_as(other.quat)
            far = (quat_rotate(yaw, other.pos) - self.pos[i]).norm(dim=-1)
            faces = quat_distance(quat_mul(yaw, other.quat), self.quat[i].expand_as(yaw))
            out[i] = (far + TURNED * faces).mean(-1)
        return out


def _sooner(qpos: Tensor, times: float) -> Tensor:
    """The same motion `times` as fast, to its last frame."""
    last = len(qpos) - 1
    at = torch.linspace(0, last, max(2, round(last / times) + 1), dtype=torch.float64)
    low = at.long().clamp(max=last - 1)
    return mixed(qpos[low], qpos[low + 1], at - low)


def mixed(a: Tensor, b: Tensor, share: Tensor) -> Tensor:
    """Frames `(T, 7 + n)` between those of `a` and of `b`, by the shares `(T)` of `b`."""
    out = torch.lerp(a, b, share.unsqueeze(-1))
    out[:, 3:7] = slerp(a[:, 3:7], b[:, 3:7], share)
    return out


def smooth(share: Tensor) -> Tensor:
    """Shares from 0 to 1 that begin and end without speed, s^2 (3 - 2 s)."""
    return share * share * (3 - 2 * share)
