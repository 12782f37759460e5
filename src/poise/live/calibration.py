"""How a person's stream comes onto the body: size, heading, floor and the place where it stands."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from poise.body import Humanoid
from poise.errors import PoiseError
from poise.kin import RetargetConfig, place_on_body
from poise.kin.hinges import wrapped
from poise.live import quats as q
from poise.live.packet import Packet
from poise.live.passage import FramePassage, Hinges
from poise.motion import Clip

#: s that are stood, m that the root may move meanwhile, and frames a second of what is measured.
STAND_S, STILL_M, RATE = 2.0, 0.25, 30.0
#: Packets of which a calibration is made at least.
FEWEST = 8


@dataclass(eq=False)
class Elsewhere:
    """Motion that goes on from elsewhere.

    Attributes:
        yaw: rad, by which its world is turned.
        shift: `(3)` m, by which it is then moved.
    """

    yaw: float = 0.0
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __call__(self, qpos: np.ndarray) -> np.ndarray:
        """Coordinates `(7 + n)` there."""
        out, turn = qpos.copy(), q.yaw(self.yaw)
        out[:3] = q.rotate(turn, qpos[:3]) + self.shift
        out[3:7] = q.mul(turn, qpos[3:7])
        return out

    def points(self, places: np.ndarray) -> np.ndarray:
        """Points `(..., 3)` m there."""
        return q.rotate(q.yaw(self.yaw), places) + self.shift

    def move(self, seen: np.ndarray, to: np.ndarray) -> None:
        """Lets the motion go on so that the coordinates `seen (7 + n)` are where and face as `to
        (7 + n)` does; heights stay."""
        turn = q.heading(to[3:7]) - q.heading(seen[3:7])
        flat = np.append(seen[:2], 0.0)
        self.shift = q.rotate(q.yaw(turn), self.shift - flat) + np.append(to[:2], 0.0)
        self.yaw = math.remainder(self.yaw + turn, 2 * math.pi)


@dataclass(eq=False)
class OntoBody:
    """Poses of one skeleton as coordinates of a body.

    `move` lets the motion go on from elsewhere; at first it is where the source has it.

    Attributes:
        where: it is, against where the source has it.
        floor: m, by which it is lifted.
        planted: `(n)` rad that are added to the hinges.
        scale: of the person's path.
    """

    passage: FramePassage
    hinges: Hinges
    feet: dict[int, np.ndarray]
    first: np.ndarray
    where: Elsewhere = field(default_factory=Elsewhere)
    floor: float = 0.0
    planted: np.ndarray | float = 0.0
    _last: np.ndarray | None = None

    @property
    def scale(self) -> float:
        """Size of the path on the body by that of the person."""
        return self.passage.factor

    @classmethod
    def by(
        cls,
        clip: Clip,
        humanoid: Humanoid,
        example: Clip,
        ease: np.ndarray,
        how: RetargetConfig | None = None,
    ) -> OntoBody:
        """From a clip that shows how the person stands, and where the floor is.

        ease: `(7 + n)`, the body at ease: hinges come as near to those as whole turns let them, since a
            joint that is a turn off would be turned all round on the way.

        Raises:
            PoiseError: a skeleton that is no human's.
        """
        on = place_on_body(clip, humanoid.table, example, RATE, how=how, near=humanoid)
        passage = FramePassage(clip, example, None if how is None else how.scale)
        feet = {j: turn.numpy() for j, turn in on.level.turns.items()}
        hinges = Hinges(example.skeleton, humanoid.table)
        out = cls(passage, hinges, feet, ease[7:])
        step = max(1, clip.frames // 60)
        own = np.stack([out(clip.root_pos[t], clip.rot[t]) for t in range(0, clip.frames, step)])
        at = [round(t / clip.fps * RATE) for t in range(0, clip.frames, step)]
        there = on.qpos[np.minimum(at, len(on.qpos) - 1)]
        out.floor = float(np.median(there[:, 2] - own[:, 2]))
        # By how much planted feet turn hips, knees and ankles, which a single frame does not tell.
        out.planted = np.median(wrapped(there[:, 7:] - own[:, 7:]), 0)
        out._last = None
        return out

    def __call__(self, root_pos: np.ndarray, rot: np.ndarray) -> np.ndarray:
        """Coordinates `(7 + n)` of a pose, on the floor."""
        root, world = self.passage(root_pos, rot)
        for joint, turn in self.feet.items():
            world[joint] = q.mul(world[joint], turn)
        last = self.first if self._last is None else self._last
        qpos = self.hinges(root, world, last)
        self._last = qpos[7:].copy()
        qpos[7:] += self.planted
        qpos[2] += self.floor
        return self.where(qpos)

    def move(self, seen: np.ndarray, to: np.ndarray) -> None:
        """See `Elsewhere.move`."""
        self.where.move(seen, to)


class Standing:
    """Collects the seconds in which a person stands, of packets as they come.

    Attributes:
        share: 0 to 1, how much of the time is over.
    """

    def __init__(self) -> None:
        self._packets: list[Packet] = []
        self.share = 0.0

    def add(self, packet: Packet) -> Clip | None:
        """The clip of the person standing, once it is whole; with a step it begins anew."""
        seen = self._packets
        if seen and (
            packet.skeleton is not seen[0].skeleton
            or packet.time_s < seen[-1].time_s
            or np.linalg.norm(packet.root_pos - seen[0].root_pos) > STILL_M
        ):
            seen.clear()
        if not seen or packet.time_s - seen[-1].time_s >= 0.5 / RATE:
            seen.append(packet)
        long = packet.time_s - seen[0].time_s
        self.share = min(1.0, long / STAND_S)
        if long < STAND_S or len(seen) < FEWEST:
            return None
        return clip_of(seen)


def clip_of(packets: list[Packet]) -> Clip:
    """Packets as a clip at their mean rate."""
    fps = (len(packets) - 1) / (packets[-1].time_s - packets[0].time_s)
    root, rot = (np.stack([getattr(p, n) for p in packets]) for n in ("root_pos", "rot"))
    return Clip(packets[0].skeleton, root, rot, float(np.clip(fps, 1.0, 240.0)), packets[0].person)


def calibrated(
    packet: Packet,
    clip: Clip,
    humanoid: Humanoid,
    example: Clip,
    ease: np.ndarray,
    how: RetargetConfig | None,
) -> OntoBody | str:
    """The calibration, or a sentence why there is none."""
    try:
        return OntoBody.by(clip, humanoid, example, ease, how)
    except PoiseError as problem:
        return f"{packet.person}: {problem.what}"
