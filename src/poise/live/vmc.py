"""VMC: what avatar tools send and take of avatars' bones, in Open Sound Control over UDP."""

from __future__ import annotations

import contextlib
import queue
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.kinematics.retarget.passage import Retargeter, local_of, world_of
from poise.live.people import Offset
from poise.live.sockets import Listener
from poise.live.stream import Inbox, Packet
from poise.motion import Clip, Skeleton
from poise.motion import quats as q

#: Bones with their parents, from the hips on; fingers, eyes and jaw are left out.
PARENTS: dict[str, str | None] = {
    "Hips": None,
    "Spine": "Hips",
    "Chest": "Spine",
    "UpperChest": "Chest",
    "Neck": "UpperChest",
    "Head": "Neck",
    **{
        side + bone: parent if parent in ("Hips", "UpperChest") else side + parent
        for side in ("Left", "Right")
        for bone, parent in (
            ("Shoulder", "UpperChest"),
            ("UpperArm", "Shoulder"),
            ("LowerArm", "UpperArm"),
            ("Hand", "LowerArm"),
            ("UpperLeg", "Hips"),
            ("LowerLeg", "UpperLeg"),
            ("Foot", "LowerLeg"),
            ("Toes", "Foot"),
        )
    },
}
#: Bones that every VRM model has.
NEEDED = tuple(
    b
    for b in PARENTS
    if b not in ("Chest", "UpperChest", "Neck") and not b.endswith(("Shoulder", "Toes"))
)
#: m, T-pose of a person of 1.6 m: x ahead, y left, z up; right sides mirror left ones.
_OFFSETS = {
    "Hips": (0.0, 0.0, 0.0),
    "Spine": (0.0, 0.0, 0.07),
    "Chest": (0.0, 0.0, 0.12),
    "UpperChest": (0.0, 0.0, 0.12),
    "Neck": (0.0, 0.0, 0.13),
    "Head": (0.01, 0.0, 0.08),
    "LeftShoulder": (0.0, 0.03, 0.10),
    "LeftUpperArm": (0.0, 0.10, 0.0),
    "LeftLowerArm": (0.0, 0.25, 0.0),
    "LeftHand": (0.0, 0.23, 0.0),
    "LeftUpperLeg": (0.0, 0.09, -0.05),
    "LeftLowerLeg": (0.0, 0.0, -0.38),
    "LeftFoot": (0.0, 0.0, -0.39),
    "LeftToes": (0.12, 0.0, -0.07),
}


def from_unity(pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places `(..., 3)` and rotations `(..., 4)` xyzw of Unity as Poise's, wxyz."""
    x, y, z = np.moveaxis(pos, -1, 0)
    a, b, c, w = np.moveaxis(quat, -1, 0)
    return np.stack((z, -x, y), -1), np.stack((w, -c, a, -b), -1)


def to_unity(pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The way back."""
    x, y, z = np.moveaxis(pos, -1, 0)
    w, a, b, c = np.moveaxis(quat, -1, 0)
    return np.stack((-y, z, x), -1), np.stack((b, -c, -a, w), -1)


def skeleton_of(offsets: Mapping[str, np.ndarray]) -> Skeleton:
    """The skeleton of the bones that a model has, `(3)` m each, in Poise's axes.

    Raises:
        PoiseError: a bone that every model has is missing.
    """
    if any(bone not in offsets for bone in NEEDED):
        raise PoiseError("bones are missing", "VRM", code="joint-missing")
    names = tuple(bone for bone in PARENTS if bone in offsets)
    parents = list[int]()
    for bone in names:
        up = PARENTS[bone]
        while up is not None and up not in offsets:
            up = PARENTS[up]
        parents.append(-1 if up is None else names.index(up))
    rows = np.array([offsets[bone] for bone in names])
    rows[0] = 0.0
    return Skeleton(names, tuple(parents), rows)


def standard() -> Skeleton:
    """A model of 1.6 m in its T-pose."""
    mirror = np.array([1.0, -1.0, 1.0])
    left = {bone: np.array(at) for bone, at in _OFFSETS.items()}
    right = {
        bone.replace("Left", "Right"): at * mirror
        for bone, at in left.items()
        if bone.startswith("Left")
    }
    return skeleton_of({**left, **right})


def t_pose(skeleton: Skeleton) -> Clip:
    """The rest pose as a clip."""
    rot = np.zeros((2, len(skeleton), 4))
    rot[..., 0] = 1.0
    return Clip(skeleton, np.zeros((2, 3)), rot, 30.0, "T-pose")


#: Bytes of a datagram, bundles in one another, messages of a datagram, arguments of one.
MOST, DEPTH, MESSAGES, ARGUMENTS = 65_507, 4, 1024, 32
_BUNDLE = b"#bundle\0"


class Message(NamedTuple):
    """An address such as "/VMC/Ext/Bone/Pos", and its arguments: numbers, words, flags."""

    address: str
    arguments: tuple[int | float | str | bool, ...]


def messages(data: bytes) -> list[Message]:
    """The messages of a datagram in order.

    Raises:
        PoiseError: it is no OSC, or too large, too deep or too long.
    """
    if not data or len(data) > MOST or len(data) % 4:
        raise PoiseError("no OSC", "datagram", code="not-osc")
    out = list[Message]()
    for message in _parts(data, DEPTH):
        out.append(message)
        if len(out) > MESSAGES:
            raise PoiseError("too many messages", "datagram", code="over-limit")
    return out


def _parts(data: bytes, depth: int) -> Iterator[Message]:
    if not data.startswith(_BUNDLE):
        yield _message(data)
        return
    if depth == 0:
        raise PoiseError("too deep", "datagram", code="nested-too-deep")
    at = 16
    if len(data) < at:
        raise PoiseError("no OSC", "datagram", code="not-osc")
    while at < len(data):
        if at + 4 > len(data):
            raise PoiseError("no OSC", "datagram", code="not-osc")
        (size,) = struct.unpack_from(">i", data, at)
        at += 4
        if size <= 0 or size % 4 or at + size > len(data):
            raise PoiseError("no OSC", "datagram", code="not-osc")
        yield from _parts(data[at : at + size], depth - 1)
        at += size


def _message(data: bytes) -> Message:
    address, at = _word(data, 0)
    tags, at = _word(data, at)
    if not address.startswith("/") or not tags.startswith(",") or len(tags) > ARGUMENTS + 1:
        raise PoiseError("no OSC", "datagram", code="not-osc")
    out = list[int | float | str | bool]()
    for tag in tags[1:]:
        if tag in "if":
            if at + 4 > len(data):
                raise PoiseError("no OSC", "datagram", code="not-osc")
            out.append(struct.unpack_from(">" + tag, data, at)[0])
            at += 4
        elif tag == "s":
            word, at = _word(data, at)
            out.append(word)
        elif tag in "TF":
            out.append(tag == "T")
        else:
            raise PoiseError("unknown argument", "datagram", code="wrong-type")
    if at != len(data):
        raise PoiseError("no OSC", "datagram", code="not-osc")
    return Message(address, tuple(out))


def _word(data: bytes, at: int) -> tuple[str, int]:
    """A word that ends with 0, filled up with 0 to a multiple of 4, and where the next part begins."""
    end = data.find(b"\0", at)
    if end < 0:
        raise PoiseError("no OSC", "datagram", code="not-osc")
    after = end + 4 - end % 4
    if after > len(data) or any(data[end:after]):
        raise PoiseError("no OSC", "datagram", code="not-osc")
    try:
        return data[at:end].decode("utf-8"), after
    except UnicodeDecodeError:
        raise PoiseError("no OSC", "datagram", code="not-osc") from None


def encoded(address: str, arguments: Sequence[int | float | str]) -> bytes:
    """A message as bytes."""
    tags, out = ",", b""
    for value in arguments:
        if isinstance(value, str):
            tags, out = tags + "s", out + _filled(value)
        elif isinstance(value, int):
            tags, out = tags + "i", out + struct.pack(">i", value)
        else:
            tags, out = tags + "f", out + struct.pack(">f", value)
    return _filled(address) + _filled(tags) + out


def bundled(parts: Sequence[bytes]) -> bytes:
    """Messages as a bundle that is due at once."""
    sized = b"".join(struct.pack(">i", len(p)) + p for p in parts)
    return _BUNDLE + struct.pack(">q", 1) + sized


def _filled(word: str) -> bytes:
    data = word.encode("utf-8") + b"\0"
    return data + bytes(-len(data) % 4)


#: Senders at once; datagrams a second of all, beyond which they are left out.
SENDERS, RATE = 16, 4000
#: m by which a bone's place may change before it is another avatar.
GROWS_M = 0.005


class Avatar:
    """The bones of one sender, as they come in datagrams of any size.

    A frame is whole when all bones of the frame before are there, or when a bone comes again.
    """

    def __init__(self, person: str):
        self.person = person
        self.skeleton: Skeleton | None = None
        self._bones: dict[str, np.ndarray] = {}
        self._known: frozenset[str] = frozenset()
        self._root = np.array([0.0, 0, 0, 0, 0, 0, 1])
        # The time that was told last, and that of the frame that is coming in.
        self._told: float | None = None
        self._time: float | None = None

    def take(self, parts: list[Message], now_s: float) -> list[Packet]:
        """The poses that a datagram makes whole.

        Raises:
            PoiseError: a message of VMC with other arguments, numbers that are none, or bones missing.
        """
        out = list[Packet]()
        for address, arguments in parts:
            if address == "/VMC/Ext/Bone/Pos":
                bone, values = _transform(arguments)
                if bone not in PARENTS:
                    continue
                if bone in self._bones:
                    out += self._whole(now_s)
                if not self._bones:
                    self._time, self._told = self._told, None
                self._bones[bone] = values
            elif address == "/VMC/Ext/Root/Pos":
                self._root = _transform(arguments)[1]
            elif address == "/VMC/Ext/T" and len(arguments) == 1 and isinstance(arguments[0], float):
                self._told = arguments[0]
        if self._known and self._known <= self._bones.keys():
            out += self._whole(now_s)
        return out

    def _whole(self, now_s: float) -> list[Packet]:
        bones, self._bones = self._bones, {}
        time_s = self._time
        skeleton, pos, rot = self._body(bones)
        self._known = frozenset(bones)
        root_pos, root_rot = from_unity(self._root[:3], self._root[3:])
        root_rot = q.normalized(root_rot)
        rot[0] = q.mul(root_rot, rot[0])
        place = root_pos + q.rotate(root_rot, pos[0])
        # A clock that stands still is none.
        at = now_s if time_s is None or not np.isfinite(time_s) or time_s <= 0 else time_s
        return [Packet(self.person, at, skeleton, place, rot)]

    def _body(self, bones: Mapping[str, np.ndarray]) -> tuple[Skeleton, np.ndarray, np.ndarray]:
        names = [bone for bone in PARENTS if bone in bones]
        values = np.array([bones[bone] for bone in names])
        pos, rot = from_unity(values[:, :3], values[:, 3:])
        norms = np.linalg.norm(rot, axis=-1, keepdims=True)
        if not (norms > 0.5).all() or not (norms < 2.0).all():
            raise PoiseError("no rotation", "VMC", code="not-a-rotation")
        old = self.skeleton
        if old is None or list(old.names) != names or np.abs(old.offsets[1:] - pos[1:]).max() > GROWS_M:
            self.skeleton = skeleton_of(dict(zip(names, pos, strict=True)))
        assert self.skeleton is not None
        return self.skeleton, pos, rot / norms


def _transform(arguments: tuple[object, ...]) -> tuple[str, np.ndarray]:
    """Name, and place and rotation as `(7)`."""
    if len(arguments) < 8 or not isinstance(arguments[0], str):
        raise PoiseError("other arguments", "VMC", code="fields-differ")
    numbers = arguments[1:8]
    if not all(isinstance(x, float) for x in numbers):
        raise PoiseError("no number", "VMC", code="not-a-number")
    out = np.array(numbers, dtype=float)
    if not np.isfinite(out).all():
        raise PoiseError("not finite", "VMC", code="not-finite")
    if np.abs(out).max() > 1000.0:
        raise PoiseError("too far away", "VMC", code="too-far")
    return arguments[0], out


class VmcSource:
    """Listens for VMC and puts poses into an inbox; each sender is a person.

    Raises:
        PoiseError: the port is taken.
    """

    def __init__(self, host: str, port: int, inbox: Inbox, clock: Callable[[], float]):
        self.inbox, self.clock = inbox, clock
        self._listener = Listener(host, port, (socket.SOCK_DGRAM,), ("VMC", "--vmc"))
        self.port, (self._socket,) = self._listener.port, self._listener.doors
        self._avatars: dict[tuple[str, int], tuple[Avatar, float]] = {}
        self._second, self._count = time.monotonic(), 0
        self._listener.hear(self._socket, self._read)

    def start(self) -> None:
        """Begins to listen."""
        self._listener.start()

    def close(self) -> None:
        """Stops."""
        self._listener.close()

    def _read(self) -> None:
        data, sender = self._socket.recvfrom(MOST)
        now = time.monotonic()
        if now - self._second > 1.0:
            self._second, self._count = now, 0
        self._count += 1
        if self._count > RATE:
            self.inbox.refuse("too many datagrams")
        else:
            self.receive(data, (sender[0], sender[1]))

    def receive(self, data: bytes, sender: tuple[str, int]) -> None:
        """Takes a datagram."""
        now = self.clock()
        try:
            parts = messages(data)
            avatar = self._avatar(sender, now)
            for packet in avatar.take(parts, now):
                self.inbox.offer(packet, now)
        except PoiseError as problem:
            self.inbox.refuse(problem.what)

    def _avatar(self, sender: tuple[str, int], now: float) -> Avatar:
        known = self._avatars.get(sender)
        if known is None:
            for old in [s for s, (_, at) in self._avatars.items() if now - at > 30.0]:
                del self._avatars[old]
            if len(self._avatars) >= SENDERS:
                raise PoiseError("too many senders", "VMC", code="over-limit")
            known = (Avatar(f"vmc {sender[0]}:{sender[1]}"), now)
        self._avatars[sender] = (known[0], now)
        return known[0]


#: Share of its turn that a model's own pose loses in a step in which its person is not followed.
FADES = 0.1


class Puppet:
    """A body's rotations as those of a VRM model.

    Args:
        table: the body.
        example: a clip on its skeleton, which shows how it stands.
        skeleton: of the model, in its T-pose; by default one of 1.6 m.
        scale: of the path; by default by the length of the legs.
    """

    def __init__(
        self,
        table: BodyTable,
        example: Clip,
        skeleton: Skeleton | None = None,
        scale: float | None = None,
    ):
        self.skeleton = skeleton or standard()
        self._own, self._rot = example.skeleton, example.rot[0]
        self._passage = Retargeter.between(example, t_pose(self.skeleton), factor=scale)
        self._row = {row.joint: i for i, row in enumerate(table.rows)}
        self._above = set(self._own.ancestors(table.rows[0].joint))

    def __call__(self, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Hips `(3)` m and local rotations `(J, 4)` for the bodies `(B, 7)` in the world."""
        hips, there = self.world(bodies)
        return hips, local_of(self.skeleton, there)

    def world(self, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same with the joints' rotations in the world."""
        own = self._own
        world = np.empty((len(own), 4))
        first = bodies[0, 3:].astype(float)
        for j, parent in enumerate(own.parents):
            if j in self._row:
                world[j] = bodies[self._row[j], 3:]
            elif j in self._above:
                world[j] = first
            else:
                world[j] = q.mul(world[parent], self._rot[j])
        pelvis = next(iter(self._row))
        root = bodies[0, :3].astype(float)
        # The root is where the pelvis is, less what lies between them.
        path = [*own.ancestors(pelvis)[::-1], pelvis]
        for a, b in pairwise(path):
            root = root - q.rotate(world[a], own.offsets[b])
        return self._passage(root, q.normalized(world))


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


class OwnPuppet:
    """The simulated body on the model of the person that it follows.

    What came in goes out, turned by what the simulated body differs from its goal: with no difference
    it is what came, to the last digit, whatever a body's hinges cannot do. Each bone's rotation is
    P_sim K with K = P_goal^-1 R, R being the person's and P the puppet's; while the character follows
    something else K fades to none.

    Args:
        table: the body.
        example: a clip on its skeleton.
    """

    def __init__(self, table: BodyTable, example: Clip):
        self._table, self._example = table, example
        self._plain = Puppet(table, example)
        self._puppet, self._factor = self._plain, 1.0
        self._turn, self._move = _nothing(self._plain.skeleton)

    def __call__(
        self, bodies: np.ndarray, goals: np.ndarray | None = None, own: Own | None = None
    ) -> tuple[Skeleton, np.ndarray, np.ndarray]:
        """Model, hips `(3)` m and local rotations `(J, 4)`, for bodies and goals `(B, 7)`."""
        if own is not None:
            self._take(own)
        puppet = self._puppet
        hips, world = puppet.world(bodies)
        if own is not None and goals is not None:
            was, there = puppet.world(goals)
            turn = q.yaw(own.where.yaw)
            place = q.rotate(turn, own.root_pos) + own.where.shift / own.factor
            self._turn = q.between(there, q.mul(turn, world_of(own.skeleton, own.rot)))
            self._move = place - was
        else:
            none = _nothing(puppet.skeleton)[0]
            self._turn = q.slerp(self._turn, none, np.full(len(none), FADES))
        return puppet.skeleton, hips + self._move, local_of(puppet.skeleton, q.mul(world, self._turn))

    def _take(self, own: Own) -> None:
        """Goes on with the person's model."""
        old = self._puppet
        same = old is not self._plain and old.skeleton.same_bones(own.skeleton, 0.005)
        if same and abs(own.factor - self._factor) < 1e-6:
            return
        scale = 1.0 / own.factor
        self._puppet = Puppet(self._table, self._example, own.skeleton, scale)
        self._factor = own.factor
        self._turn, self._move = _nothing(own.skeleton)


def _nothing(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """No turns of its joints, and no move."""
    return np.tile([1.0, 0.0, 0.0, 0.0], (len(skeleton), 1)), np.zeros(3)


def datagram(skeleton: Skeleton, hips: np.ndarray, rot: np.ndarray, time_s: float) -> bytes:
    """A pose as one bundle of VMC."""
    pos = skeleton.offsets.copy()
    pos[0] = hips
    places, turns = to_unity(pos, rot)
    parts = [
        encoded("/VMC/Ext/OK", (1,)),
        encoded("/VMC/Ext/T", (float(time_s),)),
        encoded("/VMC/Ext/Root/Pos", ("root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
    ]
    for name, place, turn in zip(skeleton.names, places.tolist(), turns.tolist(), strict=True):
        parts.append(encoded("/VMC/Ext/Bone/Pos", (name, *place, *turn)))
    return bundled(parts)


class VmcSink:
    """Sends one character to a tool; the newest pose wins.

    Args:
        to: "HOST:PORT".

    Raises:
        PoiseError: no such address.
    """

    def __init__(self, to: str, puppet: OwnPuppet, character: int = 0):
        host, _, port = to.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
            raise PoiseError(
                f"VMC goes to HOST:PORT, such as 127.0.0.1:39540, got '{to}'", code="address-malformed"
            )
        try:
            where = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)[0]
        except OSError as problem:
            raise PoiseError(
                f"there is no host '{host}' ({problem.strerror})", code="unknown-host"
            ) from problem
        self._to, self.puppet, self.character = where[4], puppet, character
        self._socket = socket.socket(where[0], socket.SOCK_DGRAM)
        self._waiting: queue.Queue[tuple[np.ndarray, np.ndarray, Own | None, float] | None]
        self._waiting = queue.Queue(2)
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def write(
        self, bodies: np.ndarray, time_s: float, goals: np.ndarray | None = None, own: Own | None = None
    ) -> None:
        """One step, `(K, B, 7)` each; returns at once."""
        k, goals = self.character, bodies if goals is None else goals
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait((bodies[k], goals[k], own, time_s))

    def close(self) -> None:
        """Stops."""
        self._waiting.put(None)
        self._thread.join(2.0)
        self._socket.close()

    def _send(self) -> None:
        while (told := self._waiting.get()) is not None:
            skeleton, hips, rot = self.puppet(*told[:3])
            # A tool that is not there refuses; it may come later.
            with contextlib.suppress(OSError):
                self._socket.sendto(datagram(skeleton, hips, rot, told[3]), self._to)
