"""Robot motion, which is told from human motion and refused by name."""

from __future__ import annotations

from pathlib import Path

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.raw import ReadOptions

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_ROOT = 7
_LEAST_JOINTS = 6


def looks_like_robot(head: bytes) -> bool:
    """Whether a file is HDF5, or rows of root position, root quaternion and joint angles alone."""
    return head.startswith(HDF5_MAGIC) or _rows(head) is not None


def refuse_robot(path: Path, options: ReadOptions) -> Clip:
    """Says what the file holds and why it is not read."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    columns = _rows(head)
    if columns is not None:
        raise PoiseError(
            f"its rows of {columns} numbers are a robot's root pose and {columns - _ROOT} joint angles "
            "(qpos), which mean nothing without the robot's model",
            path,
            "Give the human motion it was made from",
        )
    if head.startswith(HDF5_MAGIC):
        raise PoiseError(
            "HDF5 files of motion (dm_control, MuJoCo) hold the joint angles of one fixed model, which "
            "mean nothing without it",
            path,
            "Give the human motion it was made from",
        )
    raise PoiseError("it is no motion that is known", path)


def _rows(head: bytes) -> int | None:
    """The number of columns if the first line is numbers only, the 4th to 7th a unit quaternion."""
    line = head.split(b"\n", 1)[0]
    if line.count(b",") < _ROOT + _LEAST_JOINTS - 1:
        return None
    try:
        row = [float(x) for x in line.split(b",")]
    except ValueError:
        return None
    norm = sum(x * x for x in row[3:7])
    return len(row) if 0.98 < norm < 1.02 else None
