"""Outputs of characters: a recording, on disk within a second, and avatar tools that take VMC."""

from __future__ import annotations

import contextlib
import os
import queue
import socket
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import TextIO

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.formats.own import csv_text
from poise.formats.table import check_writable
from poise.kinematics import qpos_to_clip
from poise.kinematics.retargeting.passage import Retargeter, local_of, world_of
from poise.live.people import Own
from poise.live.vmc import NEEDED, PARENTS, datagram, standard, t_pose
from poise.live.world import LiveStep
from poise.motion import Clip, Skeleton
from poise.motion.rotations import normalize, quat_between, quat_mul, quat_rotate, slerp, yaw_quat

#: Frames that wait for the disk at most, and s between two writes.
WAIT, EVERY_S = 900, 0.4


class CharacterRecorder:
    """Records characters of one body.

    Each goes into a CSV of Poise's own, NAME-1.csv for the first of several, which a file of the suffix
    that was asked for replaces at the end. A crash leaves that CSV, which `poise convert` reads.

    Args:
        path: of the motion, .bvh, .glb, .csv or another that is written.
        example: a clip on the body's skeleton.

    Attributes:
        missed: frames for which the disk was too slow.

    Raises:
        PoiseError: a format that cannot be written.
    """

    def __init__(self, path: Path, table: BodyTable, example: Clip, count: int, rate_hz: float):
        check_writable(path)
        self.path, self.table, self.example = Path(path), table, example
        self.count, self.rate_hz, self.missed, self.frames = count, rate_hz, 0, 0
        self._paths: list[Path] = []
        self._waiting: queue.Queue[np.ndarray | None] | None = None
        self._thread: threading.Thread | None = None
        self.takes = 0
        self.problem = ""

    @property
    def on(self) -> bool:
        """Whether it records."""
        return self._thread is not None

    def start(self) -> None:
        """Begins a take."""
        if self.on:
            return
        self.takes += 1
        self._waiting, self.frames = queue.Queue(WAIT), 0
        self._paths = [self._named(k) for k in range(self.count)]
        self._thread = threading.Thread(target=self._write, args=(self._waiting,), daemon=True)
        self._thread.start()

    def show(self, step: LiveStep) -> None:
        """Takes a control step."""
        self.write(step.qpos)

    def write(self, qpos: np.ndarray) -> None:
        """One frame `(K, 7 + n)`; returns at once."""
        if self._waiting is None:
            return
        try:
            self._waiting.put_nowait(qpos)
            self.frames += 1
        except queue.Full:
            self.missed += 1

    def stop(self) -> list[Path]:
        """Ends the take; the files that hold it."""
        if self._waiting is None or self._thread is None:
            return []
        self._waiting.put(None)
        self._thread.join()
        self._waiting = self._thread = None
        out = list[Path]()
        for raw in self._paths:
            if not raw.exists() or self.frames < 2:
                raw.unlink(missing_ok=True)
                continue
            final = raw.with_suffix(self.path.suffix)
            if final != raw:
                write_clip(read_clip(raw), final)
                raw.unlink()
            out.append(final)
        return out

    def _named(self, k: int) -> Path:
        """A name that is free."""
        stem = self.path.stem + (f"-{k + 1}" if self.count > 1 else "")
        for take in range(1, 10_000):
            more = "" if take == 1 else f"-take{take}"
            paths = [self.path.with_name(f"{stem}{more}{s}") for s in (".csv", self.path.suffix)]
            if not any(p.exists() for p in paths):
                return paths[0]
        raise PoiseError("ten thousand takes lie there already", self.path, code="over-limit")

    def _write(self, waiting: queue.Queue[np.ndarray | None]) -> None:
        files, made, rows, due = list[TextIO](), 0, list[np.ndarray](), time.monotonic() + EVERY_S
        try:
            ended = False
            while not ended:
                try:
                    row = waiting.get(timeout=0.1)
                    ended = row is None
                    if row is not None:
                        rows.append(row)
                except queue.Empty:
                    pass
                if len(rows) < 2 or not (ended or time.monotonic() >= due):
                    continue
                due = time.monotonic() + EVERY_S
                block = np.stack(rows)
                if not files:
                    files = [p.open("w", encoding="utf-8") for p in self._paths]
                for k, file in enumerate(files):
                    file.write(self._lines(block[:, k], made, header=made == 0))
                    file.flush()
                    os.fsync(file.fileno())
                made, rows = made + len(rows), []
        except OSError as problem:
            self.problem = f"the recording ended: {problem.strerror}"
        finally:
            for file in files:
                file.close()

    def _lines(self, qpos: np.ndarray, first: int, header: bool) -> str:
        """Rows of the CSV, see `poise.formats.own`; with the lines before them for the first."""
        like = self.example.replaced(
            root_pos=qpos[:, :3], rot=self.example.rot[:1].repeat(len(qpos), 0), fps=self.rate_hz
        )
        clip = qpos_to_clip(qpos, self.table, self.example.skeleton, self.rate_hz, like, "live")
        return csv_text(clip, first, header)


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
                world[j] = quat_mul(world[parent], self._rot[j])
        pelvis = next(iter(self._row))
        root = bodies[0, :3].astype(float)
        # The root is where the pelvis is, less what lies between them.
        path = [*own.ancestors(pelvis)[::-1], pelvis]
        for a, b in pairwise(path):
            root = root - quat_rotate(world[a], own.offsets[b])
        return self._passage(root, normalize(world))


class OwnPuppet:
    """The simulated body on the model of the person that it follows.

    The pose that came in goes out, turned by what the simulated body differs from its goal: with no
    difference it is what came, to the last digit, whatever a body's hinges cannot do. Each bone's
    rotation is P_sim K with K = P_goal^-1 R, R being the person's and P the puppet's; while the
    character follows something else K fades to none.

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
            turn = yaw_quat(own.where.yaw)
            place = quat_rotate(turn, own.root_pos) + own.where.shift / own.factor
            self._turn = quat_between(there, quat_mul(turn, world_of(own.skeleton, own.rot)))
            self._move = place - was
        else:
            none = _nothing(puppet.skeleton)[0]
            self._turn = slerp(self._turn, none, np.full(len(none), FADES))
        return puppet.skeleton, hips + self._move, local_of(puppet.skeleton, quat_mul(world, self._turn))

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

    def show(self, step: LiveStep) -> None:
        """Takes a control step."""
        own = step.own[self.character]
        if own is not None and not set(NEEDED) <= set(own.skeleton.names) <= set(PARENTS):
            # A person that is no VRM model.
            own = None
        self.write(step.bodies, step.time_s, step.goals, own)

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
