"""A thread that hears what comes in at sockets, and what is let in."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import json
import selectors
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qs, urlsplit

from poise.errors import PoiseError
from poise.live.protocol import MOST_BYTES, VERSION
from poise.live.sources import JsonStream, Takes
from poise.live.stream import Inbox

#: Names of this machine.
LOOPBACK = ("127.0.0.1", "localhost", "::1")
#: Connections at once, of one address and in all; messages a second of a connection, and at once.
EACH, ALL, RATE, BURST = 16, 64, 240.0, 480.0


@dataclass(eq=False)
class Guard:
    """What is let in.

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

    def enter(self, address: str) -> str | None:
        """Counts a connection in; the reason why it may not come, else None."""
        if self._open.total() >= ALL:
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
        if self.token is None and named not in LOOPBACK:
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
        wanted = (self.token or "").encode()
        return any([hmac.compare_digest(x.encode("utf-8", "replace"), wanted) for x in (said, bearer)])

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
        """Whether one more may come now."""
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


#: s after which the thread looks whether it is to end, and that it is waited for.
LOOKS_S, ENDS_S = 0.2, 2.0


class Listener:
    """Sockets at one port, and those that are accepted there.

    Args:
        kinds: `socket.SOCK_STREAM` or `SOCK_DGRAM`, or both; each is bound to the port.
        asks: (what is listened for, the option that names the port), for the error.

    Attributes:
        port: that it has.
        doors: a socket for each kind.

    Raises:
        PoiseError: the port is taken.
    """

    def __init__(self, host: str, port: int, kinds: Sequence[int], asks: tuple[str, str]):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.doors = [socket.socket(family, kind) for kind in kinds]
        self.port = port
        try:
            for door, kind in zip(self.doors, kinds, strict=True):
                if kind == socket.SOCK_STREAM:
                    door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                door.bind((host, self.port))
                self.port = int(door.getsockname()[1])
        except OSError as problem:
            for door in self.doors:
                door.close()
            what = f"cannot listen for {asks[0]} on {host}:{port}: {problem.strerror}"
            raise PoiseError(
                what, hint=f"Give another {asks[1]} port", code="cannot-listen"
            ) from problem
        self._stop, self._selector = threading.Event(), selectors.DefaultSelector()
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def hear(self, one: socket.socket, reads: Callable[[], None]) -> None:
        """Calls `reads` whenever something is there at a socket."""
        one.setblocking(False)
        self._selector.register(one, selectors.EVENT_READ, reads)

    def leave(self, one: socket.socket) -> None:
        """Closes a socket."""
        self._selector.unregister(one)
        one.close()

    def start(self) -> None:
        """Begins to listen."""
        self._thread.start()

    def close(self) -> None:
        """Stops, and closes all sockets."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(ENDS_S)
        heard = [key.fileobj for key in self._selector.get_map().values()]
        for one in {*heard, *self.doors}:
            assert isinstance(one, socket.socket)
            one.close()
        self._selector.close()

    def _listen(self) -> None:
        while not self._stop.is_set():
            for key, _ in self._selector.select(LOOKS_S):
                # A sender that is gone, a datagram that was none: nothing ends the others.
                with contextlib.suppress(OSError):
                    key.data()


#: Connections at once, senders of datagrams that are known, refusals that a connection may cause.
MOST, SENDERS, REFUSALS = EACH, 16, 200


@dataclass(eq=False)
class _Line:
    """One sender."""

    stream: JsonStream
    bucket: Bucket = field(default_factory=Bucket)
    data: bytearray = field(default_factory=bytearray)
    known: bool = False
    refused: int = 0
    at: float = 0.0


class StreamDoor:
    """Listens on TCP and UDP at one port.

    A connection that begins with what is no message is closed, so that no page of a browser can speak
    here. With a token each connection's first line, and each datagram, must bear it as "token".

    Raises:
        PoiseError: the port is taken.
    """

    def __init__(
        self, host: str, port: int, inbox: Inbox, points: Takes, clock: Callable[[], float],
        token: str | None = None,
    ):  # fmt: skip
        self.inbox, self.points, self.clock, self._token = inbox, points, clock, token
        self._listener = Listener(
            host, port, (socket.SOCK_STREAM, socket.SOCK_DGRAM), ("keypoints", "--keypoints")
        )
        self.port, (self._tcp, self._udp) = self._listener.port, self._listener.doors
        self._tcp.listen(MOST)
        self._lines = dict[socket.socket, _Line]()
        self._senders = dict[Any, _Line]()
        self._count = 0
        self._listener.hear(self._tcp, self._accept)
        self._listener.hear(self._udp, self._receive)

    def start(self) -> None:
        """Begins to listen."""
        self._listener.start()

    def close(self) -> None:
        """Stops."""
        self._listener.close()

    def _receive(self) -> None:
        data, sender = self._udp.recvfrom(MOST_BYTES + 1)
        self._datagram(data, sender[:2])

    def _line(self) -> _Line:
        self._count += 1
        return _Line(JsonStream(self.inbox, f"k{self._count}:", self.points))

    def _accept(self) -> None:
        made, _ = self._tcp.accept()
        if len(self._lines) >= MOST:
            self.inbox.refuse("too many connections")
            _tell(made, "too many connections")
            made.close()
            return
        self._lines[made] = self._line()
        self._listener.hear(made, lambda: self._read(made))

    def _read(self, one: socket.socket) -> None:
        line = self._lines[one]
        try:
            data = one.recv(65_536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        line.data += data
        *whole, rest = line.data.split(b"\n")
        line.data = bytearray(rest)
        why = "too long" if len(rest) > MOST_BYTES else None
        for text in whole:
            why = why or self._take(line, bytes(text))
        if why is not None:
            self.inbox.refuse(why)
            _tell(one, why)
        if not data or why is not None:
            del self._lines[one]
            self._listener.leave(one)

    def _take(self, line: _Line, text: bytes) -> str | None:
        """Takes a line; the reason to close the connection, if there is one."""
        if not text.strip():
            return None
        if not line.bucket.takes():
            self.inbox.refuse("too many messages")
            return None
        if not line.known:
            if not self._knows(text):
                return "no token" if self._token else "no JSON"
            line.known = True
        line.refused += line.stream.receive(text, self.clock()) is not None
        return "too many refusals" if line.refused > REFUSALS else None

    def _datagram(self, data: bytes, sender: Any) -> None:
        now = self.clock()
        line = self._senders.get(sender)
        if line is None:
            for old in [s for s, known in self._senders.items() if now - known.at > 30.0]:
                del self._senders[old]
            if len(self._senders) >= SENDERS:
                self.inbox.refuse("too many senders")
                return
        if not self._knows(data):
            self.inbox.refuse("no token" if self._token else "no JSON")
            return
        if line is None:
            line = self._senders[sender] = self._line()
        line.at = now
        if not line.bucket.takes():
            self.inbox.refuse("too many messages")
            return
        line.stream.receive(data, now)

    def _knows(self, text: bytes) -> bool:
        """Whether a message is one at all, and bears the token where one is needed."""
        if not text.lstrip().startswith(b"{"):
            return False
        if self._token is None:
            return True
        try:
            said = json.loads(text)
        except (ValueError, RecursionError):
            return False
        token = said.get("token") if isinstance(said, dict) else None
        given = token.encode("utf-8", "replace") if isinstance(token, str) else b""
        return hmac.compare_digest(given, self._token.encode())


def _tell(one: socket.socket, why: str) -> None:
    with contextlib.suppress(OSError):
        one.send(json.dumps({"v": VERSION, "type": "refused", "why": why}).encode() + b"\n")
