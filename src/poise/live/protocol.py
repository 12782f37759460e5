"""Messages of pages and programs, checked before anything else sees them, those that they are sent, and
the settings of live motion. The protocol is described in docs/live.md."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from poise.errors import PoiseError
from poise.live.admission import VERSION
from poise.live.stream import FAR_M, NAME
from poise.motion import Skeleton
from poise.settings import Range, Share, validate

#: Joints of a skeleton.
JOINTS = 256
_MOST = 1e6
#: Verticals; -Y is that of cameras, with x to the right and z into the picture.
UPS = ("Y", "Z", "-Y")


def number(value: Any, low: float = -_MOST, high: float = _MOST) -> float:
    """A finite number within bounds."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise PoiseError("no number", "message", code="not-a-number")
    try:
        out = float(value)
    except OverflowError:
        raise PoiseError("not finite", "message", code="not-finite") from None
    if not math.isfinite(out):
        raise PoiseError("not finite", "message", code="not-finite")
    if not low <= out <= high:
        raise PoiseError("out of range", "message", code="out-of-range")
    return out


def whole(value: Any, high: int = 1024) -> int:
    """A whole number from 0 to `high`."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= high:
        raise PoiseError("no index", "message", code="wrong-type")
    return value


def triple(value: Any) -> list[float]:
    """Three numbers."""
    if not isinstance(value, list) or len(value) != 3:
        raise PoiseError("no point", "message", code="wrong-type")
    return [number(v) for v in value]


def name(value: Any) -> str:
    """A short word."""
    if not isinstance(value, str) or not 0 < len(value) <= NAME or not value.isprintable():
        raise PoiseError("no name", "message", code="not-a-name")
    return value


def flag(value: Any) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise PoiseError("no flag", "message", code="wrong-type")
    return value


def _maybe(value: Any) -> str | None:
    return None if value is None else name(value)


_CHARACTER: dict[str, Callable[[Any], Any]] = {"character": lambda v: whole(v, 15)}
#: Fields of each kind of command, all of them needed but for those of "set".
COMMANDS: dict[str, Mapping[str, Callable[[Any], Any]]] = {
    "pull": {**_CHARACTER, "body": lambda v: whole(v, 255), "point": triple, "to": triple},
    "release": _CHARACTER,
    "knock": _CHARACTER,
    "ball": _CHARACTER,
    "comply": {**_CHARACTER, "level": lambda v: number(v, 0.0, 1.0)},
    "dream": {**_CHARACTER, "on": flag},
    "pause": {"on": flag},
    "record": {"on": flag},
    "follow": {**_CHARACTER, "person": _maybe},
    "set": {
        "buffer": lambda v: number(v, 0.0, 0.4),
        "noise": lambda v: number(v, 0.0, 1.0),
        "lookahead": lambda v: whole(v, 16),
    },
}


def command(message: Mapping[str, Any]) -> dict[str, Any]:
    """A command with its fields alone.

    Raises:
        PoiseError: an unknown kind, or a field that is missing, unknown or wrong.
    """
    kind = message.get("type")
    if not isinstance(kind, str) or kind not in COMMANDS:
        raise PoiseError("unknown type", "message", code="unknown-message")
    fields = COMMANDS[kind]
    given = {k: v for k, v in message.items() if k not in ("v", "type")}
    if given.keys() - fields.keys() or (kind != "set" and fields.keys() - given.keys()):
        raise PoiseError("other fields", "message", code="fields-differ")
    return {"type": kind, **{k: fields[k](v) for k, v in given.items()}}


def numbers(value: Any, width: int, most: int) -> np.ndarray:
    """Rows of `width` numbers, `(n, width)`; NaN and infinity pass, and are refused as a packet."""
    if not isinstance(value, list) or not 0 < len(value) <= most:
        raise PoiseError("no rows", "message", code="wrong-type")
    for row in value:
        if not isinstance(row, list) or len(row) != width:
            raise PoiseError("no rows", "message", code="wrong-type")
        if any(isinstance(x, bool) or not isinstance(x, int | float) for x in row):
            raise PoiseError("no number", "message", code="not-a-number")
    try:
        return np.array(value, dtype=float)
    except OverflowError:
        raise PoiseError("not finite", "message", code="not-finite") from None


def points_of(message: Mapping[str, Any], count: int) -> np.ndarray:
    """The keypoints in a message, `(K, 3)`, Z up; NaN where one is missing.

    Raises:
        PoiseError: another number of them, or what is no point.
    """
    rows, sure = message.get("points"), message.get("confidence")
    if not isinstance(rows, list) or len(rows) != count:
        raise PoiseError("other keypoints", "message", code="keypoints-differ")
    out = numbers([[math.nan] * 3 if row is None else row for row in rows], 3, JOINTS)
    if sure is not None:
        if not isinstance(sure, list) or len(sure) != count:
            raise PoiseError("other keypoints", "message", code="keypoints-differ")
        out[~(numbers([[c] for c in sure], 1, JOINTS)[:, 0] > 0.0)] = np.nan
    out[~np.isfinite(out).all(-1)] = np.nan
    if np.nanmax(np.abs(out), initial=0.0) > FAR_M:
        raise PoiseError("too far away", "message", code="too-far")
    return turned(out, vertical(message))


def skeleton_of(message: Mapping[str, Any]) -> Skeleton:
    """The skeleton in a message, Z up.

    Raises:
        PoiseError: no such skeleton.
    """
    names, parents = message.get("names"), message.get("parents")
    if not isinstance(names, list) or not 0 < len(names) <= JOINTS:
        raise PoiseError("no names", "message", code="bad-skeleton")
    words = tuple(name(n) for n in names)
    if not isinstance(parents, list) or len(parents) != len(words):
        raise PoiseError("no parents", "message", code="bad-skeleton")
    up = [-1 if p == -1 and not isinstance(p, bool) else whole(p, len(words)) for p in parents]
    offsets = numbers(message.get("offsets"), 3, JOINTS)
    if len(offsets) != len(words) or not np.abs(offsets).max() < 100.0:
        raise PoiseError("no offsets", "message", code="bad-skeleton")
    try:
        return Skeleton(words, tuple(up), turned(offsets, vertical(message)))
    except PoiseError:
        raise PoiseError("no skeleton", "message", code="bad-skeleton") from None


def vertical(message: Mapping[str, Any]) -> str:
    """The message's vertical."""
    up = message.get("up", "Z")
    if up not in UPS:
        raise PoiseError("no vertical", "message", code="unknown-axis")
    return str(up)


def turned(values: np.ndarray, up: str) -> np.ndarray:
    """Points `(..., 3)` or rotations `(..., 4)` of a right-handed world, Z up: (x, y, z) of Y up is
    (z, x, y) of Z up; (x, y, z) of -Y up is (x, -y, -z) of Y up."""
    if up == "Z":
        return values
    if up == "-Y":
        values = values * ([1.0] * (values.shape[-1] - 2) + [-1.0, -1.0])
    head, tail = values[..., :-3], values[..., -3:]
    return np.concatenate((head, tail[..., [2, 0, 1]]), -1)


@dataclass(frozen=True)
class LiveConfig:
    """How live motion is followed.

    Attributes:
        characters: in one world.
        buffer_s: s, 0 to 0.4: half of it, and 0.05 s at least, evens out how packets come; the rest is
            known ahead. With 0 the goal is extrapolated.
        lookahead: how many characters look ahead before they act, the first ones.
        noise: 0 to 1, what is added to goals as a video estimator errs: 0.1 rad and 30 mm for 1,
            which wander within 0.3 s.
        seed: of the noise and of lookahead.
    """

    characters: Annotated[int, Range(1, 16)] = 1
    buffer_s: Annotated[float, Range(0, 0.4, unit="s")] = 0.1
    lookahead: Annotated[int, Range(0)] = 0
    noise: Share = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        validate(self)
        if self.lookahead > self.characters:
            what = f"lookahead must lie in 0 to {self.characters} characters, got {self.lookahead}"
            raise PoiseError(what, "LiveConfig", code="out-of-range")


#: Version, step, simulated time, characters, bodies; then what each does, and numbers.
HEAD = struct.Struct("<IIdHH")


def packed(
    step: int,
    time_s: float,
    doing: Sequence[int],
    bodies: np.ndarray,
    goals: np.ndarray,
    ball: np.ndarray,
) -> bytes:
    """Little-endian: version u32, step u32, time f64, K u16, B u16; K u8 what each character does,
    filled up to a multiple of 4; f32 `(K, B, 7)` of the bodies, as many of the goals, 7 of the ball."""
    k, b = bodies.shape[:2]
    head = HEAD.pack(VERSION, step, time_s, k, b) + bytes(doing) + bytes(-k % 4)
    return head + b"".join(np.ascontiguousarray(x, "<f4").tobytes() for x in (bodies, goals, ball))


def as_json(time_s: float, doing: Sequence[str], bodies: np.ndarray) -> str:
    """The same for programs: places m and rotations wxyz of the simulated bodies."""
    characters = [
        {
            "doing": what,
            "pos": np.round(rows[:, :3].astype(float), 5).tolist(),
            "quat": np.round(rows[:, 3:].astype(float), 5).tolist(),
        }
        for what, rows in zip(doing, bodies, strict=True)
    ]
    return json.dumps({"v": VERSION, "type": "bodies", "time": time_s, "characters": characters})


#: What characters do, in the order of the numbers in frames.
DOING = ("at ease", "tracks", "falls", "gets up")
