"""A process beside the loop, and what is handed over to it: its own interpreter, so that the loop is not
held up."""

from __future__ import annotations

import os
import queue
import signal
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from copy import deepcopy
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch

from poise.env.env import Snapshot

#: s that the other process has to end.
ENDS_S = 2.0

A = TypeVar("A")
B = TypeVar("B")


class SnapshotArrays(NamedTuple):
    """A snapshot of some worlds as arrays, which cost little to hand over.

    Attributes:
        worlds, physics, goal: see `env.env.Snapshot`.
    """

    worlds: Mapping[str, np.ndarray]
    physics: int
    goal: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, snapshot: Snapshot) -> SnapshotArrays:
        """Those of a snapshot; what its goal points into is copied."""
        worlds = {k: v.numpy() for k, v in snapshot.worlds.items()}
        return cls(worlds, snapshot.physics, {k: v.clone().numpy() for k, v in snapshot.goal.items()})

    def snapshot(self) -> Snapshot:
        """The snapshot."""
        worlds, goal = ({k: torch.from_numpy(v) for k, v in x.items()} for x in (self.worlds, self.goal))
        return Snapshot(worlds, self.physics, goal, None)


class Beside(Generic[A, B]):
    """Answers questions one after another in a process of its own.

    Args:
        begin: makes there what answers a question, of `args`; both are handed over once.
        nice: by how much the process comes after the loop, as `nice` counts.

    Attributes:
        ended: whether the process has ended of itself; what was asked is cancelled then.
    """

    def __init__(self, begin: Callable[..., Callable[[A], B]], args: tuple[Any, ...], nice: int):
        context = get_context("spawn")
        self._line, self._other = context.Pipe()
        # Tensors that are handed over move into shared memory, from under arrays that look at them here.
        target = (self._other, begin, deepcopy(args), nice)
        self._process = context.Process(target=_answer_all, args=target, daemon=True)
        self._asks: queue.SimpleQueue[tuple[A, Future[B]] | None] = queue.SimpleQueue()
        self._started, self.ended = threading.Event(), False
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def ask(self, asked: A) -> Future[B]:
        """The answer, once it is there."""
        out: Future[B] = Future()
        self._asks.put((asked, out))
        return out

    def _carry(self) -> None:
        """Begins the process, hands questions over and answers back; the loop waits for none of it."""
        try:
            self._process.start()
        except OSError:
            # No process, and no answers.
            self.ended = True
        finally:
            self._other.close()
            self._started.set()
        while (one := self._asks.get()) is not None:
            try:
                if not self.ended:
                    self._line.send(one[0])
                    one[1].set_result(self._line.recv())
            except (EOFError, OSError):
                self.ended = True
            if self.ended:
                one[1].cancel()

    def close(self) -> None:
        """Ends the process."""
        self._asks.put(None)
        self._started.wait()
        self._line.close()
        if self._process.pid is not None:
            self._process.terminate()
            self._process.join(ENDS_S)
            if self._process.is_alive():
                self._process.kill()
                self._process.join(ENDS_S)
        self._thread.join(ENDS_S)


def _answer_all(
    line: Connection, begin: Callable[..., Callable[[Any], Any]], args: tuple[Any, ...], nice: int
) -> None:
    """The other process answers until nobody asks any more."""
    # Ctrl-C is for the loop, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    # The loop comes first, where there is not a core for each.
    if hasattr(os, "nice"):
        os.nice(nice)
    answer = begin(*args)
    while True:
        try:
            asked = line.recv()
        except (EOFError, OSError):
            return
        line.send(answer(asked))
