"""The server: a page, its files, and three doors for WebSockets, in a thread of its own."""

from __future__ import annotations

import asyncio
import http
import json
import threading
from collections.abc import Callable
from importlib.resources import files
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from poise.errors import PoiseError
from poise.live.protocol import MOST_BYTES, VERSION, command, parse
from poise.live.sockets import WAITING, Bucket, Guard, GuardedSocket, pauses
from poise.live.sources import JsonStream, Takes
from poise.live.stream import Inbox

#: What can be fetched: a fixed list, so that no path leads to a file of the user's.
PAGES = {
    "/": ("live.page", "live.html", "text/html; charset=utf-8"),
    "/live.js": ("live.page", "live.js", "text/javascript; charset=utf-8"),
    "/stage.js": ("score.report", "stage.js", "text/javascript; charset=utf-8"),
    "/characters.js": ("live.page", "characters.js", "text/javascript; charset=utf-8"),
    "/live.css": ("live.page", "live.css", "text/css; charset=utf-8"),
    "/three.js": ("score.report", "three.min.js", "text/javascript; charset=utf-8"),
}
DOORS = ("/live", "/bodies", "/stream")
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
#: s that a handshake may take, and s between figures.
HANDSHAKE_S, FIGURES_S = 5.0, 0.25
#: Refusals that a connection is told the reasons of; more are counted alone.
TOLD = 50


class _Connection(ServerConnection):
    """A connection that is counted out when it ends."""

    guard: Guard
    _peer = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        peer = transport.get_extra_info("peername")
        # One that is gone already has no name.
        self._peer = str(peer[0]) if peer else ""
        super().connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self.guard.leave(self._peer)
        super().connection_lost(exc)


class PageServer:
    """Serves until `close`.

    Args:
        guard: what is let in; its port 0 takes a free one.
        hello: what a page is told first, see docs/live.md.
        inbox: where streams go.
        command: takes a checked command.
        figures: what is shown beside the characters, asked for a few times a second.
        clock: s, by which packets arrive.
        points: takes keypoints of streams; None takes none.

    Raises:
        PoiseError: the address is taken or is none of this machine.
    """

    def __init__(
        self,
        guard: Guard,
        hello: dict[str, Any],
        inbox: Inbox,
        command: Callable[[dict[str, Any]], None],
        figures: Callable[[], dict[str, Any]],
        clock: Callable[[], float],
        points: Takes | None = None,
    ):
        self._points = points
        self.guard, self.inbox, self.clock = guard, inbox, clock
        self._command, self._figures = command, figures
        self._hello = json.dumps({"v": VERSION, "type": "hello", **hello})
        self._pages = {path: _read(*where) for path, where in PAGES.items()}
        self._newest: tuple[bytes, str] = (b"", "")
        self._fresh: asyncio.Event | None = None
        self._numbers, self._streams = "", 0
        self._ready, self._problem = threading.Event(), ""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self.watchers = 0
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)
        self._thread.start()
        self._ready.wait(10.0)
        if self._problem:
            hint = "Give another --port, or stop the program that has it"
            raise PoiseError(
                f"cannot listen on {guard.host}:{guard.port}: {self._problem}",
                hint=hint,
                code="cannot-listen",
            )

    @property
    def url(self) -> str:
        """Where the page is, with the token."""
        host = f"[{self.guard.host}]" if ":" in self.guard.host else self.guard.host
        more = f"?token={self.guard.token}" if self.guard.token else ""
        return f"http://{host}:{self.guard.port}/{more}"

    def publish(self, frame: bytes, text: Callable[[], str] | str) -> None:
        """The newest control step; a slow page misses some. Returns at once."""
        words = text if isinstance(text, str) else (text() if self._programs else "")
        self._newest = (frame, words)
        if self._loop is not None and self._loop.is_running():
            self._loop.call_soon_threadsafe(self._wake)

    def close(self) -> None:
        """Stops serving."""
        if self._loop is not None and self._stop is not None and self._loop.is_running():
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(5.0)

    # --- the thread ---------------------------------------------------------------------------

    _programs = 0

    def _wake(self) -> None:
        if self._fresh is not None:
            fresh, self._fresh = self._fresh, asyncio.Event()
            fresh.set()

    async def _serve(self) -> None:
        self._loop, self._stop, self._fresh = (
            asyncio.get_running_loop(),
            asyncio.Event(),
            asyncio.Event(),
        )
        guard = self.guard
        kind = type("Connection", (_Connection,), {"guard": guard})
        self._loop.set_exception_handler(pauses)
        try:
            server: Server = await serve(
                self._handle, sock=GuardedSocket(guard), backlog=WAITING, process_request=self._answer,
                create_connection=kind, max_size=MOST_BYTES, max_queue=64, write_limit=65_536,
                open_timeout=HANDSHAKE_S, close_timeout=1, ping_interval=20, ping_timeout=60,
                compression=None, server_header=None, logger=_quiet(),
            )  # fmt: skip
        except OSError as problem:
            self._problem = problem.strerror or str(problem)
            self._ready.set()
            return
        guard.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        counting = asyncio.create_task(self._count())
        await self._stop.wait()
        counting.cancel()
        server.close()
        await server.wait_closed()

    async def _count(self) -> None:
        while True:
            await asyncio.sleep(FIGURES_S)
            if self.watchers:
                told = {"v": VERSION, "type": "figures", **self._figures()}
                told["strangers"] = dict(self.guard.refused)
                self._numbers = json.dumps(told)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Pages and refusals; None opens a door."""
        headers = {k: v for k, v in request.headers.raw_items()}
        headers = {k.title(): v for k, v in headers.items()}
        no = self.guard.admits(request.path, headers)
        if no is not None:
            return _response(no[0], no[1].encode() + b"\n", "text/plain")
        if request.method != "GET":
            return _response(405, b"Only GET is known here.\n", "text/plain")
        path = urlsplit(request.path).path
        if path in DOORS:
            return None
        if path not in self._pages:
            return _response(404, b"There is nothing here.\n", "text/plain")
        body, kind = self._pages[path]
        return _response(200, body, kind)

    async def _handle(self, connection: ServerConnection) -> None:
        path = urlsplit(connection.request.path if connection.request else "").path
        if path == "/stream":
            await self._receive(connection, None)
            return
        text = path == "/bodies"
        self.watchers += 1
        self._programs += text
        try:
            # What comes from now on is not missed, however long the greeting takes.
            last = self._newest
            await connection.send(self._hello)
            sending = asyncio.create_task(self._send(connection, text, last))
            try:
                await self._receive(connection, None if text else self._command)
            finally:
                sending.cancel()
        except ConnectionClosed:
            pass
        finally:
            self.watchers -= 1
            self._programs -= text

    async def _send(self, connection: ServerConnection, text: bool, last: tuple[bytes, str]) -> None:
        told = ""
        try:
            while self._fresh is not None:
                # What came while this page was sent the one before is not missed.
                if self._newest is last:
                    await self._fresh.wait()
                last = self._newest
                frame, words = last
                if text and words:
                    await connection.send(words)
                elif not text:
                    await connection.send(frame)
                    if told != self._numbers:
                        told = self._numbers
                        await connection.send(told)
        except ConnectionClosed:
            pass

    async def _receive(
        self, connection: ServerConnection, obey: Callable[[dict[str, Any]], None] | None
    ) -> None:
        bucket, path = Bucket(), urlsplit(connection.request.path if connection.request else "").path
        self._streams += path == "/stream"
        said = 0
        stream = JsonStream(self.inbox, f"{self._streams}:", self._points) if path == "/stream" else None
        try:
            async for message in connection:
                if not bucket.takes():
                    self.guard.refused["too many messages"] += 1
                    if stream is None:
                        # What still comes is read and left, so that the reason gets through.
                        closing = asyncio.create_task(connection.close(1008, "too many messages"))
                        async for _ in connection:
                            pass
                        await closing
                        return
                    # Of a burst of poses the newest count; the rest is left out.
                    continue
                if stream is not None:
                    why = stream.receive(message, self.clock())
                elif obey is not None:
                    why = _obeyed(message, obey)
                    if why is not None:
                        self.guard.refused[why] += 1
                else:
                    why = "nothing is expected here"
                said += why is not None
                if why is not None and said <= TOLD:
                    await connection.send(json.dumps({"v": VERSION, "type": "refused", "why": why}))
        except ConnectionClosed:
            pass


def _obeyed(message: str | bytes, obey: Callable[[dict[str, Any]], None]) -> str | None:
    try:
        obey(command(parse(message)))
    except PoiseError as problem:
        return problem.what
    return None


def _read(room: str, name: str, kind: str) -> tuple[bytes, str]:
    return files(f"poise.{room}").joinpath("assets").joinpath(name).read_bytes(), kind


def _response(status: int, body: bytes, kind: str) -> Response:
    headers = Headers()
    headers["Content-Type"], headers["Content-Length"] = kind, str(len(body))
    headers["Content-Security-Policy"], headers["X-Content-Type-Options"] = _POLICY, "nosniff"
    headers["Referrer-Policy"], headers["Cache-Control"] = "no-referrer", "no-store"
    headers["Connection"] = "close"
    return Response(status, http.HTTPStatus(status).phrase, headers, body)


def _quiet() -> Any:
    """A logger that says nothing: what strangers send is counted, not printed."""
    import logging

    out = logging.getLogger("poise.live.server")
    out.addHandler(logging.NullHandler())
    out.propagate = False
    return out
