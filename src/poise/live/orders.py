"""What pages want done to the characters, done between two control steps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from poise.live.aims import Aims

#: Commands that wait at most.
COMMANDS = 256
#: s after which a hand that says nothing more has let go.
HOLDS_S = 1.0


class Orders:
    """Commands that wait, and what they change.

    Attributes:
        waiting: commands that were checked, see `poise.live.commands`.
        paused: whether physics waits.
        recording: is told to begin or end a recording; None: there is none.
        pulled: when each character was last pulled at, by the loop's clock.
    """

    def __init__(self, aims: Aims):
        self.aims, self.world = aims, aims.world
        self.waiting: deque[dict[str, Any]] = deque(maxlen=COMMANDS)
        self.paused = False
        self.recording: Callable[[bool], None] | None = None
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
        elif kind == "record" and self.recording is not None:
            self.recording(command["on"])
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
            self.world.look_ahead(tuple(range(most if self.world.can_look_ahead else 0)))
