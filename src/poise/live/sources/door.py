"""TCP and UDP for programs that estimate poses: a line, or a datagram, is a message of the stream."""

from __future__ import annotations

import contextlib
import hmac
import json
import selectors
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from poise.errors import PoiseError
from poise.live.commands import MOST_BYTES, VERSION
from poise.live.packet import Inbox
from poise.live.page.guard import EACH, Bucket
from poise.live.sources.keypoints import Fits
from poise.live.sources.stream import JsonStream

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
        self, host: str, port: int, inbox: Inbox, points: Fits, clock: Callable[[], float],
        token: str | None = None,
    ):  # fmt: skip
        self.inbox, self.points, self.clock, self._token = inbox, points, clock, token
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._tcp = socket.socket(family, socket.SOCK_STREAM)
        self._udp = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._tcp.bind((host, port))
            self.port: int = self._tcp.getsockname()[1]
            self._udp.bind((host, self.port))
            self._tcp.listen(MOST)
        except OSError as problem:
            self._tcp.close()
            self._udp.close()
            what = f"cannot listen for keypoints on {host}:{port}: {problem.strerror}"
            raise PoiseError(what, hint="Give another --keypoints port") from problem
        self._lines = dict[socket.socket, _Line]()
        self._senders = dict[Any, _Line]()
        self._count, self._stop = 0, threading.Event()
        self._selector = selectors.DefaultSelector()
        for door in (self._tcp, self._udp):
            door.setblocking(False)
            self._selector.register(door, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def start(self) -> None:
        """Begins to listen."""
        self._thread.start()

    def close(self) -> None:
        """Stops."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        for one in (*self._lines, self._tcp, self._udp):
            one.close()
        self._selector.close()

    def _listen(self) -> None:
        while not self._stop.is_set():
            for key, _ in self._selector.select(0.2):
                one = key.fileobj
                assert isinstance(one, socket.socket)
                # A sender that is gone, a datagram that was none: nothing ends the others.
                with contextlib.suppress(OSError):
                    if one is self._tcp:
                        self._accept()
                    elif one is self._udp:
                        data, sender = one.recvfrom(MOST_BYTES + 1)
                        self._datagram(data, sender[:2])
                    else:
                        self._read(one)

    def _line(self) -> _Line:
        self._count += 1
        return _Line(JsonStream(self.inbox, f"k{self._count}:", self.points))

    def _accept(self) -> None:
        made, _ = self._tcp.accept()
        made.setblocking(False)
        if len(self._lines) >= MOST:
            self.inbox.refuse("too many connections")
            _tell(made, "too many connections")
            made.close()
            return
        self._lines[made] = self._line()
        self._selector.register(made, selectors.EVENT_READ)

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
            self._selector.unregister(one)
            del self._lines[one]
            one.close()

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
