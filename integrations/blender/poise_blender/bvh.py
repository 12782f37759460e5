"""BVH that goes to Poise and comes back, with numpy alone: metres, Z up, no turn at rest."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

_POSITIONS = ("Xposition", "Yposition", "Zposition")
_TURNS = ("Zrotation", "Xrotation", "Yrotation")


@dataclass(frozen=True)
class Motion:
    """Joints in the world: parents stand before their children, the first is the root.

    Attributes:
        names, parents: of the joints; the root's parent is -1.
        offsets: `(J, 3)` m from the parent at rest.
        tips: `(J, 3)` m from the joint to the end of its bone; used where a joint has no child.
        places: `(T, J, 3)` m from the parent, in the parent's axes; the root's are the world's.
        turns: `(T, J, 3, 3)` against the parent, unit matrices at rest.
        fps: frames per second.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    tips: np.ndarray
    places: np.ndarray
    turns: np.ndarray
    fps: float

    def travels(self, still_m: float = 1e-4) -> list[bool]:
        """Of each joint, whether it moves against its parent; the root does."""
        stray = np.abs(self.places - self.offsets).max(axis=(0, 2))
        return [j == 0 or bool(stray[j] > still_m) for j in range(len(self.names))]


def write(motion: Motion, path: Path) -> None:
    """Writes the motion; joints that move against their parents get position channels."""
    moving = motion.travels()
    order: list[int] = []
    lines = ["HIERARCHY"]
    stack: list[tuple[int | None, int]] = [(0, 0)]
    while stack:
        j, depth = stack.pop()
        tab = "\t" * depth
        if j is None:
            lines.append(f"{tab}}}")
            continue
        order.append(j)
        channels = (_POSITIONS if moving[j] else ()) + _TURNS
        offset = np.zeros(3) if j == 0 else motion.offsets[j]
        lines += [f"{tab}{'JOINT' if j else 'ROOT'} {motion.names[j]}", f"{tab}{{"]
        lines.append(f"{tab}\tOFFSET {_numbers(offset)}")
        lines.append(f"{tab}\tCHANNELS {len(channels)} {' '.join(channels)}")
        children = [k for k, p in enumerate(motion.parents) if p == j]
        if not children:
            tip = _numbers(motion.tips[j])
            lines += [f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET {tip}", f"{tab}\t}}"]
        stack.append((None, depth))
        stack += [(k, depth + 1) for k in reversed(children)]
    columns = []
    for j in order:
        if moving[j]:
            columns.append(motion.places[:, j])
        columns.append(np.degrees(_angles(motion.turns[:, j])))
    rows = np.concatenate(columns, -1)
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1.0 / motion.fps!r}"]
    lines += [_numbers(row) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read(path: Path) -> Motion:
    """Reads what `write` or Poise wrote.

    Raises:
        ValueError: the file is no such BVH.
    """
    head, _, data = path.read_text(encoding="utf-8").partition("MOTION")
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    tips: dict[int, list[float]] = {}
    open_: list[int] = []
    for line in head.splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] in ("ROOT", "JOINT"):
            parents.append(open_[-1] if open_ else -1)
            names.append(line.split(None, 1)[1].strip())
            offsets.append([0.0] * 3)
            channels.append([])
            open_.append(len(names) - 1)
        elif words[0] == "End":
            open_.append(-1)
        elif words[0] == "OFFSET":
            value = [float(x) for x in words[1:4]]
            if open_[-1] < 0:
                tips[open_[-2]] = value
            else:
                offsets[open_[-1]] = value
        elif words[0] == "CHANNELS":
            channels[open_[-1]] = words[2:]
        elif words[0] == "}":
            open_.pop()
    lines = data.strip().splitlines()
    if not names or len(lines) < 3:
        raise ValueError(f"{path.name} holds no motion")
    rows = np.array([[float(x) for x in line.split()] for line in lines[2:] if line.strip()])
    if rows.shape[1] != sum(map(len, channels)):
        raise ValueError(f"{path.name} has {rows.shape[1]} numbers a frame")
    rest = np.array(offsets)
    places = np.repeat(rest[None], len(rows), 0)
    turns = np.tile(np.eye(3), (len(rows), len(names), 1, 1))
    column = 0
    for j, listed in enumerate(channels):
        for name in listed:
            axis, value = "XYZ".index(name[0]), rows[:, column]
            if name in _POSITIONS:
                places[:, j, axis] = value + (rest[0, axis] if j == 0 else 0.0)
            else:
                turns[:, j] = turns[:, j] @ _about(axis, np.radians(value))
            column += 1
    ends = np.array([tips.get(j, [0.0] * 3) for j in range(len(names))])
    rate = 1.0 / float(lines[1].split()[-1])
    return Motion(tuple(names), tuple(parents), rest, ends, places, turns, rate)


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{x + 0.0:.7f}" for x in np.round(values, 7).tolist())


def _about(axis: int, angle: np.ndarray) -> np.ndarray:
    """`(T, 3, 3)` turns by `angle` (rad) about X, Y or Z."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.tile(np.eye(3), (len(angle), 1, 1))
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, j, i], out[:, i, j] = np.sin(angle), -np.sin(angle)
    return out


def _angles(turns: np.ndarray) -> np.ndarray:
    """`(T, 3)` rad, continuous: R = Rz Rx Ry."""
    x = np.arcsin(np.clip(turns[:, 2, 1], -1.0, 1.0))
    z = np.arctan2(-turns[:, 0, 1], turns[:, 1, 1])
    y = np.arctan2(-turns[:, 2, 0], turns[:, 2, 2])
    locked = np.abs(turns[:, 2, 1]) > 1.0 - 1e-9
    # At the pole only the sum of z and y is told: all of it goes to z.
    z = np.where(locked, np.arctan2(turns[:, 1, 0], turns[:, 0, 0]), z)
    y = np.where(locked, 0.0, y)
    return np.unwrap(np.stack((z, x, y), -1), axis=0)
