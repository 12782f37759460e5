"""The listening socket: strangers that are too many are told so and sent away before anything is made of
them, and no more than `A_SECOND` are looked at in a second, so that a flood costs the live stream
nothing. The rest wait in the system's queue."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import time
from typing import Any

from poise.live.page.guard import Guard

#: Connections that are looked at in a second, let in or not, and those that the system keeps waiting.
A_SECOND, WAITING = 200, 512


class Doorway(socket.socket):
    """Listens where a guard says; `accept` gives only what it lets in.

    Raises:
        OSError: the address is taken, or none of this machine.
    """

    def __init__(self, guard: Guard):
        found = socket.getaddrinfo(guard.host, guard.port, type=socket.SOCK_STREAM)[0]
        super().__init__(found[0], socket.SOCK_STREAM)
        try:
            self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.bind(found[4])
        except OSError:
            self.close()
            raise
        self.setblocking(False)
        self._guard, self._second, self._count = guard, 0.0, 0

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection that is let in.

        Raises:
            BlockingIOError: there is none.
            OSError: (EMFILE) there were too many in this second; event loops pause for one then.
        """
        while True:
            now = time.monotonic()
            if now - self._second >= 1.0:
                self._second, self._count = now, 0
            if self._count >= A_SECOND:
                raise OSError(errno.EMFILE, "too many connections in a second")
            made, peer = super().accept()
            self._count += 1
            why = self._guard.enter(str(peer[0]))
            if why is None:
                return made, peer
            _turn_away(made, why)


def _turn_away(made: socket.socket, why: str) -> None:
    body = (why + "\n").encode()
    head = (
        f"HTTP/1.1 503 Service Unavailable\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    with made, contextlib.suppress(OSError):
        made.setblocking(False)
        made.send(head.encode() + body)


def pauses(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """An exception handler for loops: a pause of a doorway is nothing to be told."""
    problem = context.get("exception")
    if not (isinstance(problem, OSError) and problem.errno == errno.EMFILE):
        loop.default_exception_handler(context)
