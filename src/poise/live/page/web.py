"""Pages, their files and doors for WebSockets behind a guard, served in a thread of its own."""

from __future__ import annotations

import asyncio
import http
import logging
import threading
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from importlib.resources import files
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from poise.errors import PoiseError
from poise.live.admission import WAITING, Guard, GuardedSocket, pauses

#: A page: the room that holds it, its name among the assets there, its type.
Asset = tuple[str, str, str]
Door = Callable[[ServerConnection], Awaitable[None]]
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
#: s that a handshake may take.
HANDSHAKE_S = 5.0
HTML, JS, CSS = (f"text/{kind}; charset=utf-8" for kind in ("html", "javascript", "css"))
#: The stage that report, live page and the page of `poise open` share.
STAGE: dict[str, Asset] = {
    "/stage.js": ("score.report", "stage.js", JS),
    "/three.js": ("score.report", "three.min.js", JS),
}
#: Refusals that a connection is told the reasons of; more are counted alone.
TOLD = 50


class Content(NamedTuple):
    """An answer for a path that is no page: bytes, their type, the name as which a browser keeps them
    ("" shows them), and a policy in place of the pages' own."""

    body: bytes
    kind: str
    keep_as: str = ""
    policy: str = _POLICY


class WebServer:
    """Serves until `close`.

    Args:
        guard: what is let in; its port 0 takes a free one.
        pages: what can be fetched by path: a fixed list, so that no path leads to a file of the user's.
        doors: who speaks with a WebSocket, by path.
        most: bytes of a message at a door.
        beside: what runs beside the server in its loop.
        more: finds what else can be fetched by path, in a thread of its own; None for nothing.

    Raises:
        PoiseError: the address is taken or is none of this machine.
    """

    def __init__(
        self,
        guard: Guard,
        pages: Mapping[str, Asset],
        doors: Mapping[str, Door],
        most: int,
        beside: Callable[[], Coroutine[Any, Any, None]] | None = None,
        more: Callable[[str], Content | None] | None = None,
    ):
        self.guard = guard
        self._pages, self._doors = {path: _read(*where) for path, where in pages.items()}, doors
        self._most, self._beside, self._more = most, beside, more
        self._ready, self._problem = threading.Event(), ""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
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
        """The address of the page, with the token."""
        host = f"[{self.guard.host}]" if ":" in self.guard.host else self.guard.host
        more = f"?token={self.guard.token}" if self.guard.token else ""
        return f"http://{host}:{self.guard.port}/{more}"

    def soon(self, call: Callable[[], None]) -> None:
        """Has the server's thread call something; returns at once."""
        if self._loop is not None and self._loop.is_running():
            self._loop.call_soon_threadsafe(call)

    def close(self) -> None:
        """Stops serving."""
        if self._stop is not None:
            self.soon(self._stop.set)
        self._thread.join(5.0)

    # --- the thread ---------------------------------------------------------------------------

    async def _serve(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        guard = self.guard
        kind = type("Connection", (_Connection,), {"guard": guard})
        self._loop.set_exception_handler(pauses)
        try:
            server: Server = await serve(
                self._handle,
                sock=GuardedSocket(guard),
                backlog=WAITING,
                process_request=self._answer,
                create_connection=kind,
                max_size=self._most,
                max_queue=64,
                write_limit=65_536,
                open_timeout=HANDSHAKE_S,
                close_timeout=1,
                ping_interval=20,
                ping_timeout=60,
                compression=None,
                server_header=None,
                logger=_quiet(),
            )
        except OSError as problem:
            self._problem = problem.strerror or str(problem)
            self._ready.set()
            return
        guard.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        beside = None if self._beside is None else asyncio.create_task(self._beside())
        await self._stop.wait()
        if beside is not None:
            beside.cancel()
        server.close()
        await server.wait_closed()

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Pages and refusals; None opens a door."""
        headers = {k.title(): v for k, v in request.headers.raw_items()}
        no = self.guard.admits(request.path, headers)
        if no is not None:
            return _response(no[0], Content(no[1].encode() + b"\n", "text/plain"))
        if request.method != "GET":
            return _response(405, Content(b"Only GET is known here.\n", "text/plain"))
        path = urlsplit(request.path).path
        if path in self._doors:
            return None
        if path in self._pages:
            return _response(200, Content(*self._pages[path]), self.guard.cookie)
        found = None if self._more is None else await asyncio.to_thread(self._more, path)
        if found is None:
            return _response(404, Content(b"There is nothing here.\n", "text/plain"))
        return _response(200, found)

    async def _handle(self, connection: ServerConnection) -> None:
        await self._doors[path_of(connection)](connection)


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


def path_of(connection: ServerConnection) -> str:
    """The path of the door at which a connection is."""
    return urlsplit(connection.request.path if connection.request else "").path


def _read(room: str, name: str, kind: str) -> tuple[bytes, str]:
    # Found by its path, since importing a room takes time.
    place = files("poise").joinpath(*room.split("."), "assets", name)
    return place.read_bytes(), kind


def _response(status: int, content: Content, cookie: str | None = None) -> Response:
    headers = Headers()
    headers["Content-Type"], headers["Content-Length"] = content.kind, str(len(content.body))
    headers["Content-Security-Policy"], headers["X-Content-Type-Options"] = content.policy, "nosniff"
    headers["Referrer-Policy"], headers["Cache-Control"] = "no-referrer", "no-store"
    headers["Connection"] = "close"
    if content.keep_as:
        headers["Content-Disposition"] = f'attachment; filename="{content.keep_as}"'
    if cookie is not None:
        headers["Set-Cookie"] = cookie
    return Response(status, http.HTTPStatus(status).phrase, headers, content.body)


def _quiet() -> Any:
    """A logger that says nothing: what strangers send is counted, not printed."""
    out = logging.getLogger("poise.live.server")
    out.addHandler(logging.NullHandler())
    out.propagate = False
    return out
