"""The recovery clips of a library, and how a character gets from lying to standing by them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from poise.body import BodyTable
from poise.env.reference import Reference
from poise.kinematics import Kinematics, close_cycle, lowest_height
from poise.motion.rotations import (
    heading_angle,
    heading_quat,
    into_heading,
    quat_angle,
    quat_between,
    quat_distance,
    quat_mul,
    quat_rotate,
    slerp,
    turned,
    yaw_quat,
)

#: Shares of the standing height: a body that is lower lies, one that is at least so high stands again.
LIES, STANDS = 0.5, 0.9
#: m/s: no part of a body that lies moves faster, on average; s: getting up lasts no longer.
STILL, UP_S = 0.6, 6.0
#: s of a walk's cycle, m/s of its travel, rad that it may turn.
CYCLE_S, TRAVEL, STRAIGHT = (0.8, 1.5), (0.7, 1.4), 0.35
#: What a m/s counts beside a m, where two frames of a cycle are compared, and m within which it closes.
SPEED_COUNTS, CLOSES = 0.1, 0.02


class Pace(NamedTuple):
    """How quickly recovery clips are played, and what is done with them.

    up: times their own speed at which clips get up. walk: times a walk's own speed at which it goes to a
    place that is more than a step away. turn: rad/s. gain: of a walk's speed, what is gained in a step.
    up_s: s that getting up lasts at most; a clip that is longer is played faster.
    """

    up: float = 1.25
    walk: float = 1.0
    turn: float = 2.0
    gain: float = 0.06
    up_s: float = 10.0


#: At which every policy can come back, and, a second sooner, one that learns it so.
CALM, QUICK = Pace(), Pace(1.75, 1.3, 2.5, 0.06, 1.7)


@dataclass(frozen=True, eq=False)
class RecoveryClips:
    """The recovery clips of a library, coordinates `(F, 7 + n)` float64.

    Attributes:
        ease: `(7 + n)`, a body that stands.
        walks: each a closed cycle along +X.
        ups: from lying to standing.
        pace: at which a policy learned to come back by them.
    """

    ease: Tensor
    walks: tuple[Tensor, ...]
    ups: tuple[Tensor, ...]
    pace: Pace = CALM

    def state(self) -> dict[str, Tensor]:
        """All of it by name, for `of`."""
        named = {f"walk {k:03}": q for k, q in enumerate(self.walks)}
        named |= {f"up {k:03}": q for k, q in enumerate(self.ups)}
        return {"ease": self.ease, "pace": torch.tensor(self.pace, dtype=torch.float64), **named}

    @classmethod
    def of(cls, state: Mapping[str, Tensor]) -> RecoveryClips:
        """From `state()`."""
        walks, ups = (
            tuple(state[k] for k in sorted(state) if k.startswith(kind)) for kind in ("walk ", "up ")
        )
        # Half and single precision know no 0.06.
        told = [round(x, 4) for x in state["pace"].tolist()] if "pace" in state else ()
        return cls(state["ease"], walks, ups, Pace(*told))


def find_recovery_clips(
    reference: Reference, ease: tuple[int, int], walking: Tensor, most: int = 2
) -> RecoveryClips | None:
    """The recovery clips of a library; None if none of its clips walks steadily or none gets up.

    Args:
        ease: (clip, frame) that stands.
        walking: `(C,)` bool, clips that walk or stand.
        most: walks, the fastest of those that close and face as walks mostly do, which leaves out walks
            backwards.
    """
    clip, frame = ease
    stand = reference.qpos[int(reference.start[clip]) + frame].cpu()
    walks = [found for c in walking.nonzero().squeeze(-1).tolist() if (found := _cycle(reference, c))]
    clips = range(len(reference.length))
    ups = [up for c in clips if (up := _gets_up(reference, c, stand)) is not None]
    if not walks or not ups:
        return None
    faces = [heading_angle(q[:, 3:7]) for _, q in walks]
    usual = math.atan2(sum(map(math.sin, faces)), sum(map(math.cos, faces)))
    ahead = [w for w, face in zip(walks, faces, strict=True) if math.cos(face - usual) > 0]
    ahead.sort(key=lambda w: (max(w[0], CLOSES), -float(w[1][-1, 0]) / len(w[1])))
    return RecoveryClips(stand, tuple(q for _, q in ahead[:most]), tuple(ups))


def _cycle(reference: Reference, clip: int) -> tuple[float, Tensor] | None:
    """How well the best cycle of a clip closes, m, and that cycle."""
    rows, rate = _rows(reference, clip), reference.rate_hz
    qpos, pose = reference.qpos[rows].cpu(), reference.pose
    low, high = (round(s * rate) for s in CYCLE_S)
    if len(qpos) <= low:
        return None
    heading = heading_quat(qpos[:, 3:7])
    pos = pose.pos[rows].cpu().double() - qpos[:, None, :3] * torch.tensor([1.0, 1.0, 0.0])
    seen = into_heading(heading, torch.cat((pos, SPEED_COUNTS * pose.linvel[rows].cpu().double()), 1))
    best: tuple[float, int, int] | None = None
    for n in range(low, min(high, len(qpos) - 1) + 1):
        travel = (qpos[n:, :2] - qpos[:-n, :2]).norm(dim=-1) * rate / n
        turn = quat_angle(quat_between(heading[:-n], heading[n:]))
        gap = (seen[n:] - seen[:-n]).norm(dim=-1).mean(-1)
        fit = (travel > TRAVEL[0]) & (travel < TRAVEL[1]) & (turn < STRAIGHT)
        gap = torch.where(fit, gap, math.inf)
        k = int(gap.argmin())
        if float(gap[k]) < (best[0] if best else math.inf):
            best = float(gap[k]), k, n
    if best is None:
        return None
    gap, k, n = best
    closed = torch.tensor(close_cycle(qpos[k : k + n + 1].numpy())[0])
    return gap, _along_x(closed)


def _gets_up(reference: Reference, clip: int, stand: Tensor) -> Tensor | None:
    """A clip's frames from where it lies most still until it stands; None if it never does."""
    rows, rate = _rows(reference, clip), reference.rate_hz
    pos, vel = reference.pose.pos[rows].cpu(), reference.pose.linvel[rows].cpu()
    top, height = pos[..., 2].amax(-1), float(stand[2])
    speed, upright = vel.norm(dim=-1).mean(-1), pos[:, 0, 2] > STANDS * height
    down = (top < LIES * height) & (speed < STILL)
    best: tuple[float, int, int] | None = None
    for k in down.nonzero().squeeze(-1).tolist():
        ups = upright[k : k + round(UP_S * rate)].nonzero().squeeze(-1)
        if len(ups) and float(speed[k]) < (best[0] if best else math.inf):
            best = float(speed[k]), k, k + int(ups[0])
    if best is None:
        return None
    # Until it stands still, or the clip ends.
    end = best[2] + int(speed[best[2] : best[2] + round(rate)].argmin())
    return reference.qpos[rows][best[1] : end + 1].cpu()


def _rows(reference: Reference, clip: int) -> slice:
    start = int(reference.start[clip])
    return slice(start, start + int(reference.length[clip]))


def _along_x(qpos: Tensor) -> Tensor:
    """A cycle that begins at the origin and travels along +X without drifting aside."""
    travel = qpos[-1, :2] - qpos[0, :2]
    out = turned(qpos, -math.atan2(float(travel[1]), float(travel[0])), qpos[0, :2], torch.zeros(2))
    out[:, 1] -= out[:, 1].mean()
    return out


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
