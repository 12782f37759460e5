"""A guard at the door of a server: it minds addresses, origins, tokens, connections and messages."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import json
import re
import socket
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlsplit

from poise.errors import PoiseError

#: Version of the protocol; bytes and depth of a message.
VERSION, MOST_BYTES, DEPTH = 1, 65_536, 5
#: Words in quotes, the last of which may not end, and brackets.
_MARKS = re.compile(r'"(?:[^"\\]|\\.)*(?:"|\\?\Z)|[\[\]{}]', re.DOTALL)
#: Names of this machine.
LOOPBACK = ("127.0.0.1", "localhost", "::1")
#: Connections at once, of one address and in all; messages a second of a connection, and at once.
EACH, ALL, RATE, BURST = 16, 64, 240.0, 480.0


@dataclass(eq=False)
class Guard:
    """Connections and requests that are let in.

    Attributes:
        host: the address that is listened on.
        port: of it.
        token: what has to be said where the host is not this machine alone; None for nothing.
        refused: how often, by the reason.
    """

    host: str
    port: int
    token: str | None = None
    refused: Counter[str] = field(default_factory=Counter)
    _open: Counter[str] = field(default_factory=Counter)

    @property
    def inside(self) -> int:
        """Connections that were counted in and not out."""
        return self._open.total()

    def enter(self, address: str) -> str | None:
        """Counts a connection in; the reason why it may not come, else None."""
        if self.inside >= ALL:
            return self._no("too many connections")
        if self._open[address] >= EACH:
            return self._no("too many connections from this address")
        self._open[address] += 1
        return None

    def leave(self, address: str) -> None:
        """Counts it out."""
        self._open[address] -= 1
        if self._open[address] <= 0:
            del self._open[address]

    def admits(self, path: str, headers: Mapping[str, str]) -> tuple[int, str] | None:
        """None for a request that is let in, else the status and the reason.

        A page of another site may ask a browser to connect here, so the origin must be this server, and
        the host a name of it, lest a stranger's name leads here (DNS rebinding).
        """
        named = _name(headers.get("Host", ""))
        if (self.token is None or self.host in LOOPBACK) and named not in LOOPBACK:
            return 403, self._no("another host")
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != headers.get("Host", ""):
            return 403, self._no("another origin")
        if self.token is not None and not self._knows(path, headers):
            return 401, self._no("no token")
        return None

    def _knows(self, path: str, headers: Mapping[str, str]) -> bool:
        said = parse_qs(urlsplit(path).query).get("token", [""])[0]
        bearer = headers.get("Authorization", "").removeprefix("Bearer ")
        wanted, given = (self.token or "").encode(), (said, bearer, self._kept(headers))
        return any([hmac.compare_digest(x.encode("utf-8", "replace"), wanted) for x in given])

    def _kept(self, headers: Mapping[str, str]) -> str:
        """The token that a browser keeps."""
        try:
            found = SimpleCookie(headers.get("Cookie", "")).get(self._cookie)
        except CookieError:
            return ""
        return "" if found is None else unquote(found.value)

    @property
    def _cookie(self) -> str:
        # Servers at other ports of the same host share a browser's cookies.
        return f"poise-{self.port}"

    @property
    def cookie(self) -> str | None:
        """The cookie of a browser that said the token, so that scripts of the page are let
        in as well, and no other site's page; None where no token is needed."""
        if self.token is None:
            return None
        return f"{self._cookie}={quote(self.token, safe='')}; Path=/; HttpOnly; SameSite=Strict"

    def _no(self, reason: str) -> str:
        self.refused[reason] += 1
        return reason


def _name(host: str) -> str:
    """The name in "name:port" or "[::1]:port"."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


class Bucket:
    """Lets `RATE` messages a second through, and `BURST` at once."""

    def __init__(self) -> None:
        self._left, self._at = BURST, time.monotonic()

    def takes(self) -> bool:
        """True if one more may come now."""
        now = time.monotonic()
        self._left = min(BURST, self._left + RATE * (now - self._at))
        self._at = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


#: Connections that are looked at in a second, let in or not, and those that the system keeps waiting.
A_SECOND, WAITING = 200, 512


class GuardedSocket(socket.socket):
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


def parse(text: str | bytes) -> dict[str, Any]:
    """A message as a dictionary.

    Raises:
        PoiseError: too long, too deep, no JSON, no object, or of another version.
    """
    if len(text) > MOST_BYTES:
        raise PoiseError("too long", "message", code="over-limit")
    try:
        words = text.decode("utf-8") if isinstance(text, bytes) else text
    except UnicodeDecodeError:
        raise PoiseError("no UTF-8", "message", code="not-text") from None
    _shallow(words)
    try:
        out = json.loads(words, parse_constant=_none)
    except (ValueError, RecursionError):
        raise PoiseError("no JSON", "message", code="bad-json") from None
    if not isinstance(out, dict):
        raise PoiseError("no object", "message", code="not-an-object")
    if out.get("v") != VERSION:
        raise PoiseError("other version", "message", f'Say "v": {VERSION}', code="version-differs")
    return out


def _none(word: str) -> float:
    """NaN and infinity are no JSON; where they are sent all the same they are seen as what they are."""
    return float(word)


def _shallow(text: str) -> None:
    depth = 0
    for found in _MARKS.finditer(text):
        mark = found[0][0]
        if mark in "[{":
            depth += 1
            if depth > DEPTH:
                raise PoiseError("too deep", "message", code="nested-too-deep")
        elif mark != '"':
            depth -= 1
