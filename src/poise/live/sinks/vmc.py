"""VMC out: the simulated body of a character for avatar tools."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.live import quats as q
from poise.live.passage import FramePassage, local_of, world_of
from poise.live.people import Elsewhere
from poise.live.sources.vmc import bundled, encoded
from poise.live.vrm import standard, t_pose, to_unity
from poise.motion import Clip, Skeleton

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
        self._passage = FramePassage(example, t_pose(self.skeleton), scale)
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
        return self._passage.turned(root, q.normalized(world))


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
    where: Elsewhere
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
            raise PoiseError(f"VMC goes to HOST:PORT, such as 127.0.0.1:39540, got '{to}'")
        try:
            where = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)[0]
        except OSError as problem:
            raise PoiseError(f"there is no host '{host}' ({problem.strerror})") from problem
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
