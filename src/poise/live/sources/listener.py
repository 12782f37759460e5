"""A thread that hears what comes in at sockets, until it is closed."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from collections.abc import Callable, Sequence

from poise.errors import PoiseError

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
            raise PoiseError(what, hint=f"Give another {asks[1]} port") from problem
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
