"""What the loop hands on after each control step: to pages, to a recording."""

from __future__ import annotations

from typing import Any

from poise.live.character import EASE, FALLS, RETURNS, TRACKS
from poise.live.loop import Live
from poise.live.page.frames import as_json, packed
from poise.live.page.server import PageServer
from poise.live.sinks.record import Recorder
from poise.live.sinks.vmc import VmcSink
from poise.live.vrm import NEEDED, PARENTS
from poise.live.world import Seen, World

#: What characters do, in the order of the numbers in frames.
DOING = (EASE, TRACKS, FALLS, RETURNS)


def hello_of(world: World, names: dict[str, Any]) -> dict[str, Any]:
    """What a page needs to draw the characters.

    names: more of it, such as whether there is a recorder.
    """
    table = world.humanoid.table
    return {
        "characters": world.count,
        "rate": world.rate_hz,
        "bodies": list(world.humanoid.bodies),
        "parents": [r.parent for r in table.rows],
        "shapes": [
            {"body": i, "kind": g.kind, "size": list(g.size), "pos": list(g.pos), "quat": list(g.quat)}
            for i, row in enumerate(table.rows)
            for g in row.geoms
        ],
        "ball": 0.12,
        "doing": list(DOING),
        "looks_ahead": world.can_look_ahead,
        **names,
    }


class ShowPage:
    """Hands steps to a page server."""

    def __init__(self, server: PageServer):
        self.server = server

    def show(self, seen: Seen, live: Live) -> None:
        """Takes a control step."""
        doing = [c.doing for c in live.world.characters]
        frame = packed(
            live.steps, seen.time_s, [DOING.index(d) for d in doing], seen.bodies, seen.goals, seen.ball
        )
        self.server.publish(frame, lambda: as_json(seen.time_s, doing, seen.bodies))


class ShowRecorder:
    """Hands steps to a recording while it is on."""

    def __init__(self, recorder: Recorder):
        self.recorder = recorder

    def show(self, seen: Seen, live: Live) -> None:
        """Takes a control step."""
        self.recorder.write(seen.qpos)


class ShowVmc:
    """Hands steps to a VMC sink."""

    def __init__(self, sink: VmcSink):
        self.sink = sink

    def show(self, seen: Seen, live: Live) -> None:
        """Takes a control step."""
        own = live.aims.own(self.sink.character)
        if own is not None and not set(NEEDED) <= set(own.skeleton.names) <= set(PARENTS):
            # A person that is no VRM model.
            own = None
        self.sink.write(seen.bodies, seen.time_s, seen.goals, own)
