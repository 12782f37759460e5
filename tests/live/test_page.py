"""The server without a character, and the page in Chromium with one."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import CHROMIUM, opened
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.live.admission import A_SECOND, EACH, MOST_BYTES, Guard
from poise.live.page.server import PAGES, PageServer
from poise.live.protocol import HEAD, LiveConfig, as_json, packed
from poise.live.session import Session, SessionConfig
from poise.live.stream import Inbox
from refusals import refused
from test_docs import WALK


class Served:
    """A server, and what it was told."""

    def __init__(self, host: str = "127.0.0.1", token: str | None = None):
        self.told: list[dict[str, Any]] = []
        self.inbox, self.guard = Inbox(), Guard(host, 0, token)
        self.server = PageServer(
            self.guard,
            {"characters": 1},
            self.inbox,
            self.told.append,
            lambda: {"hz": 30.0},
            time.monotonic,
        )
        self.where = f"127.0.0.1:{self.guard.port}"

    def get(self, path: str, **headers: str) -> tuple[int, bytes]:
        asked = urllib.request.Request(f"http://{self.where}{path}", headers=headers)
        try:
            with urllib.request.urlopen(asked, timeout=10) as got:
                return got.status, got.read()
        except urllib.error.HTTPError as problem:
            return problem.code, problem.read()


@pytest.fixture
def served() -> Iterator[Served]:
    out = Served()
    yield out
    out.server.close()


def test_a_step_as_bytes() -> None:
    bodies, goals = (np.full((3, 2, 7), x, np.float32) for x in (1.0, 2.0))
    data = packed(7, 1.5, [0, 1, 2], bodies, goals, np.arange(7, dtype=np.float32))
    assert HEAD.unpack_from(data) == (1, 7, 1.5, 3, 2)
    assert list(data[20:24]) == [0, 1, 2, 0] and len(data) == 24 + 4 * (2 * 42 + 7)
    assert struct.unpack_from("<f", data, 24 + 4 * 42)[0] == 2.0
    assert json.loads(as_json(1.5, ["tracks"] * 3, bodies))["characters"][0]["pos"][1] == [1, 1, 1]


def test_pages_and_nothing_else_are_there(served: Served) -> None:
    for path in PAGES:
        status, body = served.get(path)
        assert status == 200 and len(body) > 200, path
        assert b"http://" not in body.replace(b"http://www.w3.org", b"") or path == "/three.js"
    for path in (
        "/nothing",
        "/../pyproject.toml",
        "/%2e%2e/%2e%2e/etc/passwd",
        "//etc/passwd",
        "/live.js/..",
    ):
        assert served.get(path)[0] == 404, path
    assert served.get("/", Origin="http://evil.example")[0] == 403
    assert served.get("/", Host="evil.example")[0] == 403
    with socket.create_connection(("127.0.0.1", served.guard.port), 5) as one:
        one.settimeout(5)
        one.sendall(f"POST / HTTP/1.1\r\nHost: {served.where}\r\n\r\n".encode())
        assert one.recv(100).startswith(b"HTTP/1.1 405")


def test_commands_frames_and_figures_go_through(served: Served) -> None:
    with connect(f"ws://{served.where}/live") as page:
        assert json.loads(page.recv(5))["type"] == "hello"
        page.send('{"v": 1, "type": "knock", "character": 0}')
        page.send('{"v": 1, "type": "format disk"}')
        assert json.loads(page.recv(5)) == {"v": 1, "type": "refused", "why": "unknown type"}
        seen: set[str] = set()
        for _ in range(60):
            served.server.publish(b"frame", "text")
            got = page.recv(5)
            seen.add("frame" if isinstance(got, bytes) else json.loads(got)["type"])
            if len(seen) == 2:
                break
            time.sleep(0.02)
    assert served.told == [{"type": "knock", "character": 0}] and seen == {"frame", "figures"}


def test_the_newest_step_waits_for_nobody(served: Served) -> None:
    """A page that reads nothing makes neither the loop nor another page wait."""
    door = f"ws://{served.where}/live"
    with connect(door, max_queue=1, close_timeout=0.2) as slow, connect(door) as page:
        slow.recv(5)
        page.recv(5)
        spent = []
        for _ in range(150):
            began = time.perf_counter()
            served.server.publish(bytes(60_000), "")
            spent.append(time.perf_counter() - began)
            page.recv(5)
    assert float(np.median(spent)) < 0.005


def test_strangers_are_kept_out(served: Served) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"ws://{served.where}/live", origin="http://evil.example")  # type: ignore[arg-type]
    door = f"ws://{served.where}/stream"
    with connect(door, max_size=None) as page, pytest.raises(ConnectionClosed) as closed:
        page.send("x" * (4 * MOST_BYTES))
        page.recv(5)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009
    with connect(f"ws://{served.where}/live") as page, pytest.raises(ConnectionClosed) as closed:
        for _ in range(3000):
            page.send("{}")
        for _ in range(3000):
            page.recv(5)
    assert closed.value.rcvd is not None and closed.value.rcvd.reason == "too many messages"
    host, port = served.where.split(":")
    made = [socket.create_connection((host, int(port)), 5) for _ in range(EACH + 4)]
    try:
        for one in made:
            one.settimeout(5)
        assert made[-1].recv(100).startswith(b"HTTP/1.1 503")
    finally:
        for one in made:
            one.close()
    end = time.monotonic() + 5
    while time.monotonic() < end and served.guard.inside:
        time.sleep(0.02)
    assert served.get("/")[0] == 200


def test_a_flood_of_connections_is_looked_at_slowly_and_others_still_come_in() -> None:
    out = Served()
    where = "127.0.0.1", out.guard.port
    made: list[socket.socket] = []
    try:
        for _ in range(2 * A_SECOND):
            one = socket.socket()
            one.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                one.connect(where)
            made.append(one)
        end = time.monotonic() + 30
        while not (seen := out.guard.refused["too many connections from this address"]):
            assert time.monotonic() < end
            time.sleep(0.01)
        assert seen <= 2 * A_SECOND - EACH
        for one in made:
            one.close()
        end = time.monotonic() + 60
        status = 0
        while status != 200 and time.monotonic() < end:
            with contextlib.suppress(OSError):
                status = out.get("/")[0]
            time.sleep(0.2)
        assert status == 200
    finally:
        for one in made:
            one.close()
        out.server.close()


def test_others_need_the_token() -> None:
    out = Served("0.0.0.0", "secret word")
    try:
        assert "token=secret word" in out.server.url
        assert out.get("/")[0] == 401 and out.get("/?token=no")[0] == 401
        assert out.get("/?token=secret%20word")[0] == 200
        # Scripts of the page come without the token in their address: the browser keeps it.
        asked = urllib.request.Request(f"http://{out.where}/?token=secret%20word")
        with urllib.request.urlopen(asked, timeout=10) as got:
            cookie = got.headers["Set-Cookie"]
        assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
        kept = cookie.partition(";")[0]
        assert out.get("/live.js")[0] == 401 and out.get("/live.js", Cookie=kept)[0] == 200
        assert out.get("/live.js", Cookie=kept.replace("secret", "guess"))[0] == 401
    finally:
        out.server.close()


def test_a_port_that_is_taken_is_told(served: Served) -> None:
    with refused("cannot-listen"):
        PageServer(Guard("127.0.0.1", served.guard.port), {}, Inbox(), print, dict, time.monotonic)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_push_fall_recovery_and_record_in_chromium(tmp_path: Path) -> None:
    wanted = SessionConfig({"walk": read_clip(WALK)}, record=tmp_path / "take.bvh")
    session = Session(open_run(None).tracker, LiveConfig(), wanted)
    done = threading.Event()
    steps = threading.Thread(target=lambda: session.live.run(done.is_set, session.shows))
    steps.start()
    try:
        with opened(session.server.url, tmp_path / "profile") as page:
            page.size(480, 400)
            page.until("document.body?.dataset.doing == 'tracks' && window.poiseLive.state != null")
            page.js("document.getElementById('record').click()")
            page.until("document.getElementById('record').ariaPressed == 'true'")
            x, y = page.js("poiseLive.screen(0)")
            page.mouse("mousePressed", x, y)
            for k in range(6):
                page.mouse("mouseMoved", x + 8 * k, y - 4 * k)
            assert session.live.world.hands.pulls or session.live.commands or session.live.steps
            page.until("true")
            page.mouse("mouseReleased", x + 40, y - 20)
            key = "document.body.dispatchEvent(new KeyboardEvent('keydown', {key: '%s', bubbles: true}))"
            # Not every blow costs it its goal: some it walks off.
            for _ in range(8):
                page.js(key % "k")
                end = time.monotonic() + 4
                while time.monotonic() < end and not session.live.world.characters[0].lost:
                    time.sleep(0.05)
                if session.live.world.characters[0].lost:
                    break
            # A page that draws seldom may miss the fall itself.
            page.until("Number(document.getElementById('recovered').textContent) >= 1", 60)
            page.until("document.body.dataset.doing == 'tracks'", 60)
            for level in ("0.05", "0.1"):
                page.js(key % "+")
                page.until(f"document.body.dataset.compliance == '{level}'", 60)
            page.js("document.getElementById('dream').click()")
            page.until("document.getElementById('dream').ariaPressed == 'true'")
            page.until("document.getElementById('says').textContent.includes('endless motion')")
            page.js(key % "e")
            page.until("!document.getElementById('says').textContent.includes('endless motion')")
            page.js("document.getElementById('record').click()")
            page.until("document.getElementById('says').textContent.includes('take.bvh')")
            assert page.errors == [] and page.js("document.body.dataset.status") == "live"
    finally:
        done.set()
        steps.join(10)
        session.close()
    assert read_clip(tmp_path / "take.bvh").frames > 30
