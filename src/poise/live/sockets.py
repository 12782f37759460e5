"""A thread that hears what comes in at sockets, and keypoints over TCP and UDP."""

from __future__ import annotations

import contextlib
import hmac
import json
import selectors
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from poise.errors import PoiseError
from poise.live.admission import EACH, MOST_BYTES, VERSION, Bucket
from poise.live.sources import JsonStream, Takes
from poise.live.stream import Inbox

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
