"""What is let in: tokens, origins, caps of connections and of messages."""

from __future__ import annotations

import hmac
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import parse_qs, urlsplit

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
