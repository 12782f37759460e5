"""A live session: sources, loop, page and sinks joined, and ended together.

The loop: 30 times a second what came becomes goals, goals become actions, actions become motion. It
never waits. Sources put packets into an `Inbox`, pages put commands into a bounded queue, and a step
is handed to the page and the sinks, each of which takes the newest when it can.
"""

from __future__ import annotations

import gc
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.jobs.endless.model import load_generator
from poise.jobs.tracker import Tracker
from poise.live.admission import Guard
from poise.live.page.server import PageServer
from poise.live.people import STAND, Steady
from poise.live.points import PointFit
from poise.live.protocol import DOING, LiveConfig, as_json, packed
from poise.live.sinks import CharacterRecorder, OwnPuppet, VmcSink
from poise.live.sockets import StreamDoor
from poise.live.sources import FileSource
from poise.live.stream import Inbox, StreamTremble
from poise.live.targets import Targets
from poise.live.vmc import VmcSource
from poise.live.world import LiveStep, LiveWorld
from poise.motion import Clip
from poise.synthesis.generator import Kinematic

#: Commands that wait at most.
MOST_ORDERS = 256
#: s after which a hand that says nothing more has let go.
HOLDS_S = 1.0


class CommandQueue:
    """Commands that wait, and what they change.

    Attributes:
        waiting: commands that were checked, see `poise.live.protocol`.
        paused: whether physics waits.
        pulled: when each character was last pulled at, by the loop's clock.
    """

    def __init__(self, aims: Targets):
        self.aims, self.world = aims, aims.world
        self.waiting: deque[dict[str, Any]] = deque(maxlen=MOST_ORDERS)
        self.paused = False
        self.pulled: dict[int, float] = {}

    def obey(self, now_s: float) -> None:
        """Does what waits."""
        while self.waiting:
            self._do(self.waiting.popleft(), now_s)
        for k in [k for k, t in self.pulled.items() if now_s - t > HOLDS_S]:
            del self.pulled[k]
            self.world.hands.let_go(k)

    def _do(self, command: dict[str, Any], now_s: float) -> None:
        kind, k, world = command["type"], int(command.get("character", 0)), self.world
        if k >= world.count:
            return
        if kind == "pull":
            if command["body"] < len(world.humanoid.bodies):
                world.hands.pull(k, command["body"], np.array(command["point"]), np.array(command["to"]))
                self.pulled[k] = now_s
        elif kind == "release":
            self.pulled.pop(k, None)
            world.hands.let_go(k)
        elif kind == "knock":
            angle = self.aims.rng.uniform(0, 2 * np.pi)
            world.hands.blow(k, np.array([np.cos(angle), np.sin(angle), 0.0]))
        elif kind == "ball":
            world.drop_ball(k)
        elif kind == "comply":
            world.comply(k, command["level"])
        elif kind == "dream":
            self.aims.dream(k, command["on"])
        elif kind == "pause":
            self.paused = command["on"]
        elif kind == "follow":
            self.aims.people.switch(k, command["person"])
        elif kind == "set":
            self._set(command)

    def _set(self, command: dict[str, Any]) -> None:
        if "buffer" in command:
            self.aims.people.delay(command["buffer"])
            self.aims.set_lead()
        if "noise" in command:
            self.aims.noise = command["noise"]
        if "lookahead" in command:
            most = min(command["lookahead"], self.world.count)
            self.aims.look_ahead(tuple(range(most if self.world.can_look_ahead else 0)))


#: Packets by which it is known when they come; s after them at which a step begins; s by which one step
#: is moved at most; s that must be gained for it to be moved.
SEEN, MARGIN_S, MOVES_S, GAINS_S = 64, 0.003, 0.0005, 0.002


class Phase:
    """Sources have clocks of their own. A packet that comes just after a step began waits a whole period
    for the next one; one that comes before it does not wait at all.

    Steps are moved, by no more than `MOVES_S` each, to where 95 % of the packets wait the least. Packets
    that come at any time, as those of many sources, leave them where they are.

    Args:
        period_s: s between steps.
    """

    def __init__(self, period_s: float):
        self.period_s = period_s
        self._came: deque[float] = deque(maxlen=SEEN)

    def add(self, arrived_s: list[float]) -> None:
        """When packets came, by the loop's clock."""
        self._came += arrived_s

    def shift(self, due_s: float) -> float:
        """s by which a step that is due at `due_s` is to come later; less than 0 for sooner."""
        if len(self._came) < SEEN:
            return 0.0
        period = self.period_s
        phases = (np.array(self._came) - due_s) % period
        starts = np.append((phases + MARGIN_S) % period, 0.0)
        # What comes less than a margin before a step might as well come after it.
        waits = np.percentile((starts[:, None] - phases - MARGIN_S / 2) % period, 95, axis=1)
        best = int(waits.argmin())
        if waits[best] > waits[-1] - GAINS_S:
            return 0.0
        # The shorter way round.
        way = (float(starts[best]) + period / 2) % period - period / 2
        return float(np.clip(way, -MOVES_S, MOVES_S))


#: Steps of which figures are made.
STEPS = 1800


class Times:
    """When the last control steps began, how long they took, and how late they were.

    Attributes:
        steps: that were made.
    """

    def __init__(self) -> None:
        self.steps = 0
        self._latency: deque[float] = deque(maxlen=STEPS)
        self._spent: deque[float] = deque(maxlen=STEPS)
        self._began: deque[float] = deque(maxlen=90)

    def add(self, began_s: float, done_s: float, arrived_s: list[float]) -> None:
        """What a step took, and when the newest packets that it knew had come."""
        self._spent.append(done_s - began_s)
        self._began.append(began_s)
        self._latency += [done_s - arrived for arrived in arrived_s]

    def told(self) -> dict[str, Any]:
        """Steps a second, and ms."""
        began = self._began
        span = began[-1] - began[0] if len(began) > 1 else 0.0
        return {
            "hz": round((len(began) - 1) / span, 1) if span > 0 else 0.0,
            "latency_ms": _percentiles(self._latency),
            "step_ms": _percentiles(self._spent),
        }


def figures(aims: Targets, inbox: Inbox, times: Times) -> dict[str, Any]:
    """Those of the people and characters; times in ms, over the last minute."""
    world, people = aims.world, aims.people
    return {
        **times.told(),
        "buffer": people.delay_s, "noise": aims.noise, "lookahead": len(world.wanted),
        "looked_ahead": round(world.looked / max(1, times.steps), 3),
        "resets": world.resets, "help_n": 0.0, "received": inbox.received,
        "refused": dict(inbox.refused), "crowded": inbox.crowded,
        "people": [
            {
                "name": p.name, "calibrated": round(p.share, 2), "said": "" if p.onto else p.said,
                **_of_tremble(p.buffer.tremble),
            }
            for p in people.known.values()
        ]
        + [
            {"name": name, "calibrated": round(share, 2), "said": STAND, **_of_tremble(StreamTremble())}
            for name, share in list(inbox.standing.items())
        ],
        "characters": [_of_character(aims, k) for k in range(world.count)],
    }  # fmt: skip


def _of_tremble(tremble: StreamTremble) -> dict[str, Any]:
    """By how many mm a person trembles, at how many Hz, and how many ms later it is followed."""
    hz = None if tremble.hz is None else round(tremble.hz, 1)
    return {"trembles_mm": round(tremble.mm), "hz": hz, "late_ms": round(1000.0 * tremble.late_s)}


def _of_character(aims: Targets, k: int) -> dict[str, Any]:
    c, world = aims.world.characters[k], aims.world
    return {
        "follows": aims.people.follows[k], "doing": c.doing, "lost": c.lost, "falls": c.falls,
        "recovered": c.recovered, "off_mm": round(1000.0 * world.body(k).off_m),
        "compliance": round(float(world.yielding.level[k]), 3), "endless": k in aims.endless,
    }  # fmt: skip


def _percentiles(seconds: deque[float]) -> list[float]:
    """ms that half of them, and 99 % of them, are below."""
    kept = np.array(seconds) * 1000.0 if seconds else np.zeros(1)
    return [round(float(np.percentile(kept, p)), 1) for p in (50, 99)]


def hello_of(table: BodyTable, count: int, rate_hz: float, more: Mapping[str, Any]) -> dict[str, Any]:
    """What a page needs to draw the characters.

    more: of it, such as whether there is a recorder.
    """
    return {
        "characters": count,
        "rate": rate_hz,
        "bodies": [r.name for r in table.rows],
        "parents": [r.parent for r in table.rows],
        "shapes": [
            {"body": i, "kind": g.kind, "size": list(g.size), "pos": list(g.pos), "quat": list(g.quat)}
            for i, row in enumerate(table.rows)
            for g in row.geoms
        ],
        "ball": 0.12,
        "doing": list(DOING),
        **more,
    }


#: What a step goes to; it returns at once.
Shows = Callable[[LiveStep], None]
#: s for which no character looks ahead after a step that came too late.
HURRIES_S = 2.0


class Live:
    """The world, the people, and the clock.

    Args:
        inbox: where sources put packets.
        executor: calibrates and plans beside the loop, and characters look ahead in a process of its
            own; None does it at once, as tests do.
        clock: s; the clock by which packets arrive.
        generator: makes endless motion; None: there is none.

    Attributes:
        world: the characters; `aims`, what they are to do; `people`, that they follow; `orders`, what
            pages want.
        behind: control steps that came too late.
    """

    def __init__(
        self,
        tracker: Tracker,
        config: LiveConfig | None = None,
        inbox: Inbox | None = None,
        executor: Executor | None = None,
        clock: Callable[[], float] = time.perf_counter,
        generator: Kinematic | None = None,
    ):
        self.config = c = config or LiveConfig()
        self.tracker, self.inbox = tracker, inbox or Inbox(Steady)
        ahead, beside = tuple(range(c.lookahead)), executor is not None
        self.world = LiveWorld(tracker, c.characters, executor, ahead, c.seed, beside)
        self.aims = Targets(self.world, c, executor, generator)
        self.people, self.orders = self.aims.people, CommandQueue(self.aims)
        self.commands = self.orders.waiting
        self.rate_hz, self.clock = self.world.rate_hz, clock
        self.behind, self._hurry, self.times = 0, 0, Times()
        self._phase = Phase(1.0 / self.rate_hz)

    @property
    def steps(self) -> int:
        """Control steps that were made."""
        return self.times.steps

    @property
    def paused(self) -> bool:
        """Whether physics waits."""
        return self.orders.paused

    def run(self, until: Callable[[], bool], shows: Sequence[Shows] = ()) -> None:
        """Steps in real time until `until()`, handing each to `shows`; late ones are not made up for."""
        period = 1.0 / self.rate_hz
        due = self.clock()
        while not until():
            now = self.clock()
            if now < due:
                time.sleep(min(due - now, 0.05))
                continue
            if now - due > period:
                self.behind += int((now - due) / period)
                due = now
                # Better in time than far-sighted.
                self._hurry = self.steps + round(HURRIES_S * self.rate_hz)
            due += period
            self.step(now, shows)
            due += self._phase.shift(due)

    def step(self, now_s: float, shows: Sequence[Shows] = ()) -> LiveStep | None:
        """One control step at `now_s`, which goes to `shows`; None while paused."""
        began = self.clock()
        packets = self.inbox.take()
        self.people.add(packets)
        self.orders.obey(now_s)
        if self.paused:
            return None
        self.world.hurries = self.steps < self._hurry
        seen = self.world.step(*self.aims.next(now_s))
        self.times.steps += 1
        if self.steps % 30 == 0:
            self.people.tidy(now_s)
        for show in shows:
            show(seen)
        arrived = [t for line in packets.values() for t, _ in line[-1:]]
        self._phase.add(arrived)
        self.times.add(began, self.clock(), arrived)
        return seen

    def figures(self) -> dict[str, Any]:
        """What is shown beside the characters; times in ms, over the last minute."""
        told = figures(self.aims, self.inbox, self.times)
        return {**told, "behind": self.behind, "paused": self.paused}

    def close(self) -> None:
        """Frees the simulations."""
        self.aims.close()
        self.world.close()


#: Steps that are made at least; s for which a thread beside the loop has the interpreter, where both
#: want it.
FEWEST, SWITCH_S = 3, 0.0005


@dataclass(frozen=True)
class SessionConfig:
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

    def __init__(self, tracker: Tracker, config: LiveConfig, wanted: SessionConfig):
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="poise-live")
        self.inbox, clock = Inbox(Steady), time.perf_counter
        made = generator_for(tracker)
        self.live = Live(tracker, config, self.inbox, executor=self._pool, clock=clock, generator=made)
        world = self.live.world
        self.recorder = CharacterRecorder(
            wanted.record, world.humanoid.table, tracker.example, world.count, world.rate_hz
        )
        self.recorded: list[Path] = []
        self.last: dict[str, Any] = {}
        more = {"looks_ahead": world.can_look_ahead, "records": True, "dreams": made is not None}
        hello = hello_of(world.humanoid.table, world.count, world.rate_hz, more)
        places = tracker.config.goal == "keypoints"
        self.points = PointFit(self.inbox, tracker.example, world.humanoid.table, places)
        guard = Guard(wanted.host, wanted.port, wanted.token)
        self.server = PageServer(
            guard, hello, self.inbox, self._command, self.figures, clock, self.points.offer
        )
        self.shows: list[Shows] = [self._show, self.recorder.show]
        self.files = FileSource(dict(wanted.clips), self.inbox, clock)
        self.vmc = None if wanted.vmc is None else VmcSource(wanted.host, wanted.vmc, self.inbox, clock)
        self.door = None
        if wanted.keypoints is not None:
            self.door = StreamDoor(
                wanted.host, wanted.keypoints, self.inbox, self.points.offer, clock, wanted.token
            )
        self.sink = None
        if wanted.vmc_out is not None:
            self.sink = VmcSink(wanted.vmc_out, OwnPuppet(world.humanoid.table, tracker.example))
            self.shows.append(self.sink.show)
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
                ),
                self.shows,
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

    def _show(self, step: LiveStep) -> None:
        text = partial(as_json, step.time_s, step.doing, step.bodies)
        doing = [DOING.index(d) for d in step.doing]
        self.server.publish(
            packed(step.step, step.time_s, doing, step.bodies, step.goals, step.ball), text
        )

    def _command(self, command: dict[str, Any]) -> None:
        """Takes a checked command of a page: all but those to record are the loop's."""
        if command["type"] != "record":
            self.live.commands.append(command)
        elif command["on"]:
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
