"""The server of live motion: a page, its files, and three doors for WebSockets."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from poise.errors import PoiseError
from poise.live.admission import MOST_BYTES, VERSION, Bucket, Guard, parse
from poise.live.page.web import CSS, HTML, JS, STAGE, TOLD, Asset, WebServer, path_of
from poise.live.protocol import command
from poise.live.sources import JsonStream, Takes
from poise.live.stream import Inbox

#: Files that can be fetched.
PAGES: dict[str, Asset] = {
    "/": ("live.page", "live.html", HTML),
    "/live.js": ("live.page", "live.js", JS),
    "/characters.js": ("live.page", "characters.js", JS),
    "/live.css": ("live.page", "live.css", CSS),
    **STAGE,
}
#: s between figures.
FIGURES_S = 0.25


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
        self._newest: tuple[bytes, str] = (b"", "")
        self._fresh: asyncio.Event | None = None
        self._numbers, self._streams = "", 0
        self.watchers = self._programs = 0
        doors = {"/live": self._watched, "/bodies": self._watched, "/stream": self._streamed}
        self._web = WebServer(guard, PAGES, doors, MOST_BYTES, self._count)

    @property
    def url(self) -> str:
        """The address of the page, with the token."""
        return self._web.url

    def publish(self, frame: bytes, text: Callable[[], str] | str) -> None:
        """The newest control step; a slow page misses some. Returns at once."""
        words = text if isinstance(text, str) else (text() if self._programs else "")
        self._newest = (frame, words)
        self._web.soon(self._wake)

    def close(self) -> None:
        """Stops serving."""
        self._web.close()

    # --- in the server's thread ---------------------------------------------------------------

    def _wake(self) -> None:
        if self._fresh is not None:
            fresh, self._fresh = self._fresh, asyncio.Event()
            fresh.set()

    async def _count(self) -> None:
        self._fresh = asyncio.Event()
        while True:
            await asyncio.sleep(FIGURES_S)
            if self.watchers:
                told = {"v": VERSION, "type": "figures", **self._figures()}
                told["strangers"] = dict(self.guard.refused)
                self._numbers = json.dumps(told)

    async def _streamed(self, connection: ServerConnection) -> None:
        await self._receive(connection, None)

    async def _watched(self, connection: ServerConnection) -> None:
        text = path_of(connection) == "/bodies"
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
        bucket, path = Bucket(), path_of(connection)
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
