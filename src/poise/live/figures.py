"""What is shown beside the characters."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from poise.live.aims import Aims
from poise.live.packet import Inbox, Tremble
from poise.live.people import STAND

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


def figures(aims: Aims, inbox: Inbox, times: Times) -> dict[str, Any]:
    """Those of the people and characters; times in ms, over the last minute."""
    world, people = aims.world, aims.people
    return {
        **times.told(),
        "buffer": people.delay_s, "noise": aims.noise, "lookahead": len(world.ahead_of),
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
            {"name": name, "calibrated": round(share, 2), "said": STAND, **_of_tremble(Tremble())}
            for name, share in list(inbox.standing.items())
        ],
        "characters": [_of_character(aims, k) for k in range(world.count)],
    }  # fmt: skip


def _of_tremble(tremble: Tremble) -> dict[str, Any]:
    """By how many mm a person trembles, at how many Hz, and how many ms later it is followed."""
    hz = None if tremble.hz is None else round(tremble.hz, 1)
    return {"trembles_mm": round(tremble.mm), "hz": hz, "late_ms": round(1000.0 * tremble.late_s)}


def _of_character(aims: Aims, k: int) -> dict[str, Any]:
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
