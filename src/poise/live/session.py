"""A live session: sources, loop, page and sinks joined, and ended together."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from poise.errors import PoiseError
from poise.jobs.endless.model import load_generator
from poise.jobs.tracker import Tracker
from poise.live.config import LiveConfig
from poise.live.loop import Live
from poise.live.packet import Inbox
from poise.live.page.guard import Guard
from poise.live.page.server import PageServer
from poise.live.points import PointFit
from poise.live.show import ShowPage, ShowRecorder, ShowVmc, hello_of
from poise.live.sinks.record import Recorder
from poise.live.sinks.vmc import OwnPuppet, VmcSink
from poise.live.sources.door import StreamDoor
from poise.live.sources.file import FileSource
from poise.live.sources.vmc import VmcSource
from poise.live.steady import Steady
from poise.motion import Clip
from poise.synth.generator import Kinematic

#: Steps that are made at least; s for which a thread beside the loop has the interpreter, where both
#: want it.
FEWEST, SWITCH_S = 3, 0.0005


@dataclass(frozen=True)
class Wanted:
    """What a session is made of.

    Attributes:
        clips: played as people, by their names.
        keypoints: TCP and UDP port on which keypoints are listened for, None for none.
        vmc: UDP port on which VMC is listened for, None for none.
        vmc_out: HOST:PORT to which the first character is sent as VMC.
        record: where recordings go.
        host: address of the page.
        port: of the page, 0 for a free one.
        token: that strangers must know.
        records: whether it records from the start.
    """

    clips: Mapping[str, Clip] = field(default_factory=dict)
    keypoints: int | None = None
    vmc: int | None = None
    vmc_out: str | None = None
    record: Path = Path("live.bvh")
    host: str = "127.0.0.1"
    port: int = 0
    token: str | None = None
    records: bool = False


class Session:
    """Runs until it is closed.

    Raises:
        PoiseError: a port that is taken, a policy that cannot get up, a format that cannot be written.
    """

    def __init__(self, tracker: Tracker, config: LiveConfig, wanted: Wanted):
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="poise-live")
        self.inbox, clock = Inbox(Steady), time.perf_counter
        made = generator_for(tracker)
        self.live = Live(tracker, config, self.inbox, executor=self._pool, clock=clock, generator=made)
        world = self.live.world
        self.recorder = Recorder(
            wanted.record, world.humanoid.table, tracker.example, world.count, world.rate_hz
        )
        self.recorded: list[Path] = []
        self.last: dict[str, Any] = {}
        self.live.orders.recording = self._record
        hello = hello_of(world, {"records": True, "dreams": made is not None})
        places = tracker.config.goal == "keypoints"
        self.points = PointFit(self.inbox, tracker.example, world.humanoid.table, places)
        guard = Guard(wanted.host, wanted.port, wanted.token)
        self.server = PageServer(
            guard, hello, self.inbox, self.live.commands.append, self.figures, clock, self.points
        )
        self.live.shows += [ShowPage(self.server), ShowRecorder(self.recorder)]
        self.files = FileSource(dict(wanted.clips), self.inbox, clock)
        self.vmc = None if wanted.vmc is None else VmcSource(wanted.host, wanted.vmc, self.inbox, clock)
        self.door = None
        if wanted.keypoints is not None:
            self.door = StreamDoor(
                wanted.host, wanted.keypoints, self.inbox, self.points, clock, wanted.token
            )
        self.sink = None
        if wanted.vmc_out is not None:
            self.sink = VmcSink(wanted.vmc_out, OwnPuppet(world.humanoid.table, tracker.example))
            self.live.shows.append(ShowVmc(self.sink))
        self.files.start()
        self.points.start()
        if self.door is not None:
            self.door.start()
        if self.vmc is not None:
            self.vmc.start()
        if wanted.records:
            self.recorder.start()

    def figures(self) -> dict[str, Any]:
        """Those of the loop, and what is recorded."""
        more = {"recording": self.recorder.on, "recorded": [p.name for p in self.recorded[-4:]]}
        return {**self.live.figures(), **more}

    def run(self, until_s: float | None = None) -> None:
        """Steps in real time, until a moment of `time.perf_counter` where one is given; on a machine
        that is busy, at least so many steps that there is something to record."""
        live, usual = self.live, sys.getswitchinterval()
        # What is there stays, and need not be looked through for garbage again and again.
        gc.collect()
        gc.freeze()
        sys.setswitchinterval(SWITCH_S)
        try:
            live.run(
                lambda: (
                    until_s is not None
                    and time.perf_counter() >= until_s
                    and (live.steps >= FEWEST or live.paused)
                )
            )
        finally:
            sys.setswitchinterval(usual)
            gc.unfreeze()

    def close(self) -> list[Path]:
        """Ends everything; the files of the recordings."""
        self.last = self.figures()
        self.files.close()
        if self.door is not None:
            self.door.close()
        self.points.close()
        if self.vmc is not None:
            self.vmc.close()
        if self.sink is not None:
            self.sink.close()
        self.server.close()
        self._pool.shutdown(wait=True, cancel_futures=True)
        self.recorded += self.recorder.stop()
        self.live.close()
        return self.recorded

    def _record(self, on: bool) -> None:
        if on:
            self.recorder.start()
        else:
            # Files are written beside the loop.
            self._pool.submit(lambda: self.recorded.extend(self.recorder.stop()))


def generator_for(tracker: Tracker) -> Kinematic | None:
    """What makes endless motion for a policy's body; None where none comes along for it."""
    model = load_generator()
    if model.fps != tracker.config.sim.control_hz:
        return None
    try:
        return model.generator(tracker.humanoid)
    except PoiseError:
        return None
