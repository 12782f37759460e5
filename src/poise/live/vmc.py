"""VMC: what avatar tools send and take of avatars' bones, in Open Sound Control over UDP."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from poise.errors import PoiseError
from poise.live.sockets import Listener
from poise.live.stream import Inbox, Packet
from poise.motion import Clip, Skeleton
from poise.motion.rotations import normalize, quat_mul, quat_rotate

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
    """Places `(..., 3)` and rotations `(..., 4)` xyzw of Unity as Poise's, wxyz.

    Unity's world is left-handed, Y up, and a model faces +Z; Poise's has Z up, and a model faces +X.
    Unity's (x, y, z) is Poise's (z, -x, y). That is a reflection, by which a rotation about an axis
    turns the other way: Unity's (w, x, y, z) is Poise's (w, -z, x, -y).
    """
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
        root_rot = normalize(root_rot)
        rot[0] = quat_mul(root_rot, rot[0])
        place = root_pos + quat_rotate(root_rot, pos[0])
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
