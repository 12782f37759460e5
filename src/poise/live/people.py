"""People of the streams: each is calibrated, read at even times, and followed by one character."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from threading import Lock
from typing import NamedTuple

import numpy as np

from poise.body import Humanoid
from poise.errors import PoiseError
from poise.kinematics import RetargetConfig, place_on_body
from poise.kinematics.coords import Hinges, wrapped
from poise.kinematics.retargeting.passage import Retargeter, doublings, world_of
from poise.kinematics.stream_noise import FadingFilter
from poise.live.stream import PEOPLE, Earlier, JitterBuffer, Packet, StreamPose, StreamTremble, leapt
from poise.motion import Clip, Skeleton
from poise.motion.rotations import ahead_angle, normalize, quat_mul, quat_rotate, yaw_quat

#: s that are stood, m that the root may move meanwhile, and frames a second of what is measured.
STAND_S, STILL_M, RATE = 2.0, 0.25, 30.0
#: Packets of which a calibration is made at least.
FEWEST = 8


@dataclass(eq=False)
class Offset:
    """Motion that goes on from elsewhere.

    Attributes:
        yaw: rad, by which its world is turned.
        shift: `(3)` m, by which it is then moved.
    """

    yaw: float = 0.0
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __call__(self, qpos: np.ndarray) -> np.ndarray:
        """Coordinates `(..., 7 + n)` there."""
        out, turn = qpos.copy(), yaw_quat(self.yaw)
        out[..., :3] = quat_rotate(turn, qpos[..., :3]) + self.shift
        out[..., 3:7] = quat_mul(turn, qpos[..., 3:7])
        return out

    def points(self, places: np.ndarray) -> np.ndarray:
        """Points `(..., 3)` m there."""
        return quat_rotate(yaw_quat(self.yaw), places) + self.shift

    def back(self, places: np.ndarray) -> np.ndarray:
        """Points `(..., 3)` m from there to where the source has them."""
        return quat_rotate(yaw_quat(-self.yaw), places - self.shift)

    def move(self, seen: np.ndarray, to: np.ndarray) -> None:
        """Lets the motion go on so that the coordinates `seen (7 + n)` are where and face as `to
        (7 + n)` does; heights stay."""
        turn = ahead_angle(to[3:7]) - ahead_angle(seen[3:7])
        flat = np.append(seen[:2], 0.0)
        self.shift = quat_rotate(yaw_quat(turn), self.shift - flat) + np.append(to[:2], 0.0)
        self.yaw = math.remainder(self.yaw + turn, 2 * math.pi)


@dataclass(eq=False)
class Calibration:
    """Poses of one skeleton as coordinates of a body.

    `where` lets the motion go on from elsewhere; at first it is where the source has it.

    Attributes:
        where: it is, against where the source has it.
        floor: m, by which it is lifted.
        planted: `(n)` rad that are added to the hinges.
        scale: of the person's path.
    """

    passage: Retargeter
    hinges: Hinges
    feet: dict[int, np.ndarray]
    first: np.ndarray
    where: Offset = field(default_factory=Offset)
    floor: float = 0.0
    planted: np.ndarray | float = 0.0
    _last: np.ndarray | None = None

    @property
    def scale(self) -> float:
        """Size of the path on the body by that of the person."""
        return self.passage.scale.factor

    @classmethod
    def by(
        cls,
        clip: Clip,
        humanoid: Humanoid,
        example: Clip,
        ease: np.ndarray,
        how: RetargetConfig | None = None,
    ) -> Calibration:
        """From a clip that shows how the person stands, and where the floor is.

        ease: `(7 + n)`, the body at ease: hinges come as near to those as whole turns let them, since a
            joint that is a turn off would be turned all round on the way.

        Raises:
            PoiseError: a skeleton that is no human's.
        """
        on = place_on_body(clip, humanoid.table, example, RATE, how=how, near=humanoid)
        passage = Retargeter.between(clip, example, factor=None if how is None else how.scale)
        feet = dict(on.level.turns)
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
        root, world = self.passage(root_pos, world_of(self.passage.source, rot))
        for joint, turn in self.feet.items():
            world[joint] = quat_mul(world[joint], turn)
        last = self.first if self._last is None else self._last
        qpos = self.hinges(root, world, last)
        self._last = qpos[7:].copy()
        qpos[7:] += self.planted
        qpos[2] += self.floor
        return self.where(qpos)


class StandingMeasure:
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
) -> Calibration | str:
    """The calibration, or a sentence why there is none."""
    try:
        return Calibration.by(clip, humanoid, example, ease, how)
    except PoiseError as problem:
        return f"{packet.person}: {problem.what}"


#: s by which a clock goes back that began anew.
ANEW_S = 2.0


class Steady:
    """The poses of one person, in the order in which they come. One that does not tremble is given back
    as it came."""

    def __init__(self, skeleton: Skeleton):
        self.skeleton = skeleton
        self._fading: FadingFilter | None = None
        self._last = np.zeros((len(skeleton), 4))
        self._root = np.zeros(3)
        self._times = deque[float](maxlen=16)
        self._busy = Lock()

    @property
    def tremble(self) -> StreamTremble:
        """What the person does now."""
        fading = self._fading
        return (
            StreamTremble()
            if fading is None
            else StreamTremble(fading.noise.mm, fading.noise.hz, fading.late_s)
        )

    def __call__(
        self, time_s: float, root: np.ndarray, rot: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The pose of `time_s` as it is known, None where a newer one came before it."""
        with self._busy:
            times = self._times
            dt = time_s - times[0] if times else 0.0
            if -ANEW_S <= dt <= 0.0 and times:
                return None
            if self._fading is None:
                self._fading = self._begun(rot)
            z = self._channels(root, rot)
            leaps = bool(times) and leapt(self._root, root, dt)
            if leaps or dt < 0.0:
                times.clear()
            times.appendleft(time_s)
            self._root = root
            if leaps:
                self._fading.restart(z)
                return root, rot
            x = self._fading(z, dt)
            return (root, rot) if x is z else (x[-3:], self._rotations(x))

    def before(self) -> list[Earlier]:
        """The poses before it, from the latest on, by all that came since; none if nothing trembles."""
        if self._fading is None:
            return []
        known = zip(list(self._times)[1:], self._fading.before(), strict=False)
        return [Earlier(t, x[-3:], self._rotations(x)) for t, x in known]

    def _channels(self, root: np.ndarray, rot: np.ndarray) -> np.ndarray:
        """`(C)`: rotations, each of the sign of the one before, and the root."""
        flip = (rot * self._last).sum(-1, keepdims=True) < 0
        self._last = np.where(flip, -rot, rot)
        return np.concatenate((self._last.ravel(), root))

    def _rotations(self, x: np.ndarray) -> np.ndarray:
        return normalize(x[:-3].reshape(-1, 4))

    def _begun(self, rot: np.ndarray) -> FadingFilter:
        count = len(self.skeleton)
        groups = np.append(np.repeat(np.arange(count), 4), [count] * 3)
        at = self._places(np.append(rot.ravel(), np.zeros(3))[None])[0]
        far = np.zeros((count, count))
        for j in range(count):
            above = j
            while above >= 0:
                far[above, j] = np.linalg.norm(at[j] - at[above])
                above = self.skeleton.parents[above]
        # A turn that errs by a variance v, the sum over its components, moves what is d m away by
        # sqrt(8 v / 3) d.
        weights = np.append(np.sqrt(8.0 / 3.0 * (far**2).mean(1)), 1.0)
        return FadingFilter(groups, weights, self._places)

    def _places(self, channels: np.ndarray) -> np.ndarray:
        """`(T, J, 3)` m of channels `(T, C)`."""
        skeleton = self.skeleton
        world = world_of(skeleton, channels[:, :-3].reshape(len(channels), -1, 4))
        above = np.maximum(skeleton.parents, 0)
        out = quat_rotate(world[:, above], np.asarray(skeleton.offsets))
        out[:, 0] = channels[:, -3:]
        for joints, parents in doublings(tuple(skeleton.parents)):
            out[:, joints] = out[:, parents] + out[:, joints]
        return out


class Own(NamedTuple):
    """A person's pose at the moment of a character's goal, on the person's own model.

    Attributes:
        skeleton: the model.
        root_pos: `(3)` m.
        rot: `(J, 4)` wxyz, local.
        where: turns and moves the person's world to where the character is.
        factor: size of the character's path by that of the person.
    """

    skeleton: Skeleton
    root_pos: np.ndarray
    rot: np.ndarray
    where: Offset
    factor: float


#: s without a packet after which a person is away, and after which it is forgotten.
AWAY_S, FORGET_S = 1.0, 20.0

#: What is asked of a person at first.
STAND = "stand still for 2 s"

#: Makes the calibration of a packet's skeleton from a clip; a sentence where that fails.
Calibrate = Callable[..., Calibration | str]


class Person:
    """One person of a stream.

    Attributes:
        onto: how its poses come onto the body; None before it is calibrated.
        said: why it has no calibration yet.
    """

    def __init__(self, name: str, delay_s: float):
        self.name, self.buffer = name, JitterBuffer(delay_s)
        self.onto: Calibration | None = None
        self.said = STAND
        self.arrived_s = -np.inf
        self._first: Packet | None = None
        self._standing = StandingMeasure()
        self._made: Future[Calibration | str] | None = None

    @property
    def share(self) -> float:
        """0 to 1, how far the calibration is."""
        return 1.0 if self.onto is not None else self._standing.share

    def add(self, packet: Packet, arrived_s: float, calibrate: Callable[..., object]) -> None:
        """One more packet. calibrate: is called with a packet that has a clip to be calibrated by."""
        first = self._first
        other = first is not None and packet.skeleton is not first.skeleton
        if other and first is not None and not packet.skeleton.same_bones(first.skeleton, 0.005):
            self.forget()
        if self._first is None:
            self._first = packet
        self.arrived_s = arrived_s
        p, tremble = packet, packet.tremble or StreamTremble()
        self.buffer.add(p.time_s, arrived_s, p.root_pos, p.rot, p.places, tremble, p.held_s, p.earlier)
        if self.onto is None and self._made is None:
            whole = packet.whole or self._standing.add(packet)
            if whole is not None:
                self._made = calibrate_with(calibrate, packet, whole)

    def forget(self) -> None:
        """Another body stands there: it is calibrated anew."""
        self.buffer = JitterBuffer(self.buffer.delay_s)
        self.onto = self._made = self._first = None
        self._standing = StandingMeasure()

    def ready(self) -> bool:
        """Whether it is calibrated; takes over a calibration that was made beside the loop."""
        if self._made is not None and self._made.done():
            made, self._made = self._made.result(), None
            if isinstance(made, str):
                self.said, self._standing = made, StandingMeasure()
            else:
                self.onto = made
        return self.onto is not None

    def read(self, now_s: float) -> StreamPose | None:
        """Its pose, None before anything came or since it is away."""
        pose = self.buffer.read(now_s)
        return None if pose is None or pose.stale_s > AWAY_S else pose


def calibrate_with(
    calibrate: Callable[..., object], packet: Packet, whole: object
) -> Future[Calibration | str]:
    """The calibration, as a future whatever `calibrate` gives."""
    made = calibrate(packet, whole)
    if isinstance(made, Future):
        return made
    out: Future[Calibration | str] = Future()
    out.set_result(made)  # type: ignore[arg-type]
    return out


class People:
    """All people that are there, and which of them each character follows.

    Args:
        count: characters.
        calibrate: (packet, clip) to a calibration; beside the loop where `executor` is given.

    Attributes:
        follows: name of the person that each character follows, None for none.
        turned_away: people that found no place.
    """

    def __init__(
        self, count: int, delay_s: float, calibrate: Calibrate, executor: Executor | None = None
    ):
        self.delay_s, self._calibrate, self._executor = delay_s, calibrate, executor
        self.known: dict[str, Person] = {}
        self.follows: list[str | None] = [None] * count
        self.turned_away = 0

    def add(self, packets: dict[str, list[tuple[float, Packet]]]) -> None:
        """What came since the last control step."""
        for name, line in packets.items():
            person = self.known.get(name)
            if person is None:
                if len(self.known) >= PEOPLE:
                    self.turned_away += 1
                    continue
                person = self.known[name] = Person(name, self.delay_s)
            for arrived, packet in line:
                person.add(packet, arrived, self._start)
            if name not in self.follows and None in self.follows:
                self.follows[self.follows.index(None)] = name

    def _start(self, packet: Packet, whole: object) -> object:
        if self._executor is None:
            return self._calibrate(packet, whole)
        return self._executor.submit(self._calibrate, packet, whole)

    def tidy(self, now_s: float) -> None:
        """Forgets people that have been away for long; a character takes the next one."""
        gone = [n for n, p in self.known.items() if now_s - p.arrived_s > FORGET_S]
        for name in gone:
            del self.known[name]
            self.follows = [None if f == name else f for f in self.follows]

    def switch(self, character: int, name: str | None) -> None:
        """A character follows another person from now on, None for none; one that is followed
        already changes places."""
        if name is not None and name in self.follows:
            self.follows[self.follows.index(name)] = self.follows[character]
        self.follows[character] = name

    def of(self, character: int) -> Person | None:
        """The person that a character follows."""
        name = self.follows[character]
        return None if name is None else self.known.get(name)

    def delay(self, seconds: float) -> None:
        """Length of all buffers from now on."""
        self.delay_s = seconds
        for person in self.known.values():
            person.buffer.delay_s = seconds
