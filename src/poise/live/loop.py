"""The loop: 30 times a second what came becomes goals, goals become actions, actions become motion.

It never waits. Sources put packets into an `Inbox`, pages put commands into a bounded queue, and what a
step came to goes to those that show or keep it, each of which takes the newest when it can.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol

from poise.jobs.tracker import Tracker
from poise.live.aims import Aims
from poise.live.config import LiveConfig
from poise.live.figures import Times, figures
from poise.live.orders import Orders
from poise.live.packet import Inbox
from poise.live.phase import Phase
from poise.live.steady import Steady
from poise.live.world import Seen, World
from poise.synth.generator import Kinematic

#: s for which no character looks ahead after a step that came too late.
HURRIES_S = 2.0


class Shows(Protocol):
    """What a step's outcome goes to; it returns at once."""

    def show(self, seen: Seen, live: Live) -> None:
        """Takes a control step."""
        ...


class Live:
    """The world, the people, and the clock.

    Args:
        inbox: where sources put packets.
        shows: what steps go to.
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
        shows: Sequence[Shows] = (),
        executor: Executor | None = None,
        clock: Callable[[], float] = time.perf_counter,
        generator: Kinematic | None = None,
    ):
        self.config = c = config or LiveConfig()
        self.tracker, self.inbox, self.shows = tracker, inbox or Inbox(Steady), list(shows)
        ahead, beside = tuple(range(c.lookahead)), executor is not None
        self.world = World(tracker, c.characters, executor, ahead, c.seed, beside)
        self.aims = Aims(self.world, c, executor, generator)
        self.people, self.orders = self.aims.people, Orders(self.aims)
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

    def run(self, until: Callable[[], bool]) -> None:
        """Steps in real time until `until()`; a step that comes late is not made up for."""
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
            self.step(now)
            due += self._phase.shift(due)

    def step(self, now_s: float) -> Seen | None:
        """One control step at `now_s`; None while paused."""
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
        for show in self.shows:
            show.show(seen, self)
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
        self.world.close()
