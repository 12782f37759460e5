"""docs/live.md: its messages are what the doors take, and nothing is left out."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from poise.live.admission import parse
from poise.live.protocol import COMMANDS, as_json, command
from poise.live.sources import JsonStream, KeypointFrame
from poise.live.stream import Inbox
from test_docs import ROOT

PAGE = (ROOT / "docs" / "live.md").read_text(encoding="utf-8")


def messages() -> list[dict[str, Any]]:
    out, decoder = list[dict[str, Any]](), json.JSONDecoder()
    for block in re.findall(r"```json\n(.*?)```", PAGE, re.S):
        rest = block.strip()
        while rest:
            message, end = decoder.raw_decode(rest)
            out.append(message)
            rest = rest[end:].strip()
    return out


class Kept:
    def __init__(self) -> None:
        self.frames = list[KeypointFrame]()

    def offer(self, frame: KeypointFrame) -> None:
        self.frames.append(frame)


def test_every_message_of_the_page_is_taken() -> None:
    inbox, kept = Inbox(), Kept()
    stream, seen = JsonStream(inbox, "", kept.offer), set[str]()
    for message in messages():
        kind, text = message["type"], json.dumps(message)
        seen.add(kind)
        if kind in COMMANDS:
            assert command(parse(text))["type"] == kind
        elif kind in ("skeleton", "pose", "keypoints"):
            assert stream.receive(text, 0.0) is None, message
    assert {"skeleton", "pose", "keypoints", "pull", "bodies", "refused"} <= seen
    ((_, packet),) = inbox.take()["anna"]
    assert packet.root_pos[2] == 0.95 and len(kept.frames) == 1
    assert np.isnan(kept.frames[0].points[1]).all()
    (told,) = [m for m in messages() if m["type"] == "bodies"]
    made = json.loads(as_json(3.5, ["tracks"], np.ones((1, 1, 7), np.float32)))
    assert told.keys() == made.keys() and told["characters"][0].keys() == made["characters"][0].keys()


def test_commands_and_reasons_are_all_on_the_page() -> None:
    for kind, fields in COMMANDS.items():
        assert f"`{kind}`" in PAGE, kind
        assert all(f"`{name}`" in PAGE for name in fields), kind
    rooms = ("protocol.py", "stream.py", "points.py", "sources.py", "sockets.py")
    for room in rooms:
        text = (ROOT / "src/poise/live" / room).read_text(encoding="utf-8")
        said = re.findall(r'(?:PoiseError\(|refuse\(|return )"([a-z][a-zA-Z -]+)"', text)
        missing = [why for why in said if f"`{why}`" not in PAGE]
        assert not missing, (room, missing)
