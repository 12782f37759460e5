"""VMC out: the simulated body of a character for avatar tools."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
from itertools import pairwise

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.live import quats as q
from poise.live.passage import FramePassage, local_of
from poise.live.sources.osc import bundled, encoded
from poise.live.vrm import standard, t_pose, to_unity
from poise.motion import Clip, Skeleton


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
        hips, there = self._passage.turned(root, q.normalized(world))
        return hips, local_of(self.skeleton, there)


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

    def __init__(self, to: str, puppet: Puppet, character: int = 0):
        host, _, port = to.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
            raise PoiseError(f"VMC goes to HOST:PORT, such as 127.0.0.1:39540, got '{to}'")
        try:
            where = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)[0]
        except OSError as problem:
            raise PoiseError(f"there is no host '{host}' ({problem.strerror})") from problem
        self._to, self.puppet, self.character = where[4], puppet, character
        self._socket = socket.socket(where[0], socket.SOCK_DGRAM)
        self._waiting: queue.Queue[tuple[np.ndarray, float] | None] = queue.Queue(2)
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def write(self, bodies: np.ndarray, time_s: float) -> None:
        """One step, `(K, B, 7)`; returns at once."""
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait((bodies[self.character], time_s))

    def close(self) -> None:
        """Stops."""
        self._waiting.put(None)
        self._thread.join(2.0)
        self._socket.close()

    def _send(self) -> None:
        while (told := self._waiting.get()) is not None:
            hips, rot = self.puppet(told[0])
            # A tool that is not there refuses; it may come later.
            with contextlib.suppress(OSError):
                self._socket.sendto(datagram(self.puppet.skeleton, hips, rot, told[1]), self._to)
