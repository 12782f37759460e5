"""JSON messages of one connection as packets: a skeleton once, then poses or keypoints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from poise.errors import PoiseError
from poise.live.commands import (
    JOINTS,
    name,
    number,
    numbers,
    parse,
    points_of,
    skeleton_of,
    turned,
    vertical,
)
from poise.live.stream import PEOPLE, Inbox, Packet
from poise.motion import Skeleton


class Frame(NamedTuple):
    """Keypoints `(K, 3)` m of a person, Z up, NaN where one is missing, and when they were and came."""

    person: str
    names: tuple[str, ...]
    points: np.ndarray
    time_s: float
    arrived_s: float


class Fits(Protocol):
    """What frames go to."""

    def offer(self, frame: Frame) -> None:
        """Takes a frame; returns at once."""
        ...


class JsonStream:
    """What one connection sends, see docs/live.md.

    Args:
        inbox: where packets go; what is refused is counted there.
        own: what is put before the names of people, so that connections keep apart.
        points: fits keypoints; None takes none.
    """

    def __init__(self, inbox: Inbox, own: str = "", points: Fits | None = None):
        self.inbox, self._own, self._points = inbox, own, points
        self._labels = dict[str, tuple[str, ...]]()
        self._skeletons: dict[str, tuple[Skeleton, str]] = {}

    def receive(self, text: str | bytes, arrived_s: float) -> str | None:
        """Takes a message; the reason, if it was refused."""
        try:
            self._take(parse(text), arrived_s)
        except PoiseError as problem:
            self.inbox.refuse(problem.what)
            return problem.what
        return None

    def _take(self, message: Mapping[str, Any], arrived_s: float) -> None:
        kind, person = message.get("type"), name(message.get("person", "person"))
        if kind == "skeleton":
            if person not in self._skeletons and len(self._skeletons) >= PEOPLE:
                raise PoiseError("too many people", "message")
            self._skeletons[person] = skeleton_of(message), vertical(message)
            return
        if kind == "keypoints":
            self._keypoints(message, person, arrived_s)
            return
        if kind != "pose":
            raise PoiseError("unknown type", "message")
        if person not in self._skeletons:
            raise PoiseError("no skeleton yet", "message")
        skeleton, up = self._skeletons[person]
        time_s = number(message["time"]) if "time" in message else arrived_s
        root = numbers([message.get("root")], 3, 1)[0]
        rot = numbers(message.get("rotations"), 4, JOINTS)
        packet = Packet((self._own + person)[:64], time_s, skeleton, turned(root, up), turned(rot, up))
        self.inbox.offer(packet, arrived_s)

    def _keypoints(self, message: Mapping[str, Any], person: str, arrived_s: float) -> None:
        if self._points is None:
            raise PoiseError("no keypoints here", "message")
        if "names" in message:
            if person not in self._labels and len(self._labels) >= PEOPLE:
                raise PoiseError("too many people", "message")
            told = message["names"]
            if not isinstance(told, list) or not 0 < len(told) <= JOINTS:
                raise PoiseError("no names", "message")
            labels = tuple(name(n) for n in told)
            if len(set(labels)) < len(labels):
                raise PoiseError("no names", "message")
            self._labels[person] = labels
        labels = self._labels.get(person)
        if labels is None:
            raise PoiseError("no names yet", "message")
        if "points" not in message:
            return
        points = points_of(message, len(labels))
        time_s = number(message["time"]) if "time" in message else arrived_s
        self._points.offer(Frame((self._own + person)[:64], labels, points, time_s, arrived_s))
