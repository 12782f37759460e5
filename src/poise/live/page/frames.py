"""A control step as bytes, and as JSON for programs."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence

import numpy as np

from poise.live.commands import VERSION

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
