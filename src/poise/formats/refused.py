"""Files that are known and no motion of a human: what they hold, and what to give instead."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from poise.errors import PoiseError
from poise.formats.raw import ReadOptions

FLAT_HINT = "Triangulate the cameras first, for example with Pose2Sim, and give its TRC file"
"""What to do with 2D keypoints."""
LOOKED_AT = 1000
"""Files of a folder among which one is sought that tells what the folder holds."""
_HUMAN_HINT = "Give the human motion it was made from"
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_ROOT = 7
_LEAST_JOINTS = 6


def looks_like_asf(head: bytes) -> bool:
    """Whether a file's first bytes are those of an ASF skeleton."""
    lines = [line.strip().lower() for line in head.splitlines()]
    return any(x.split()[:1] in ([b":bonedata"], [b":units"], [b":version"]) for x in lines if x)


def refuse_asf(path: Path, options: ReadOptions) -> NoReturn:
    """A skeleton alone does not move."""
    raise PoiseError(
        "an ASF file holds a skeleton without motion",
        path,
        "Give the AMC file, with --skeleton FILE",
        code="skeleton-alone",
    )


def looks_like_robot(head: bytes) -> bool:
    """Whether a file is HDF5, or rows of root position, root quaternion and joint angles alone."""
    return head.startswith(_HDF5_MAGIC) or _robot_columns(head) is not None


def refuse_robot(path: Path, options: ReadOptions) -> NoReturn:
    """Joint angles mean nothing without the model that they turn."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    columns = _robot_columns(head)
    if columns is not None:
        raise PoiseError(
            f"its rows of {columns} numbers are a robot's root pose and {columns - _ROOT} joint angles "
            "(qpos), which mean nothing without the robot's model",
            path,
            _HUMAN_HINT,
            code="robot-motion",
        )
    raise PoiseError(
        "HDF5 files of motion (dm_control, MuJoCo) hold the joint angles of one fixed model, which "
        "mean nothing without it",
        path,
        _HUMAN_HINT,
        code="robot-motion",
    )


def _robot_columns(head: bytes) -> int | None:
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


def is_qpos(data: Mapping[str, Any]) -> bool:
    """Whether named arrays are a robot's coordinates."""
    return any(k in data for k in ("qpos", "dof_pos", "joint_pos", "dof"))


def refuse_qpos(data: Mapping[str, Any], path: Path, options: ReadOptions) -> NoReturn:
    """The same for arrays as for rows of text."""
    raise PoiseError(
        "it holds the joint angles of a robot (qpos), which mean nothing without the robot's model",
        path,
        _HUMAN_HINT,
        code="robot-motion",
    )


def refuse_array(shape: tuple[int, ...], path: Path) -> NoReturn:
    """One array that is no motion by itself: what its shape tells, and what to give."""
    what = f"it holds one array of shape {shape} without joint names or a frame rate"
    hint = "Joints of SMPL are (T, 22, 3) or (T, 24, 3); save others as npz with named arrays"
    if len(shape) == 4 and shape[2:] in ((22, 3), (24, 3)):
        what = f"its array of shape {shape} holds {shape[0]} clips"
        hint = "Save each as a file of its own"
    elif len(shape) == 2 and shape[1] in (66, 72):
        joints = (shape[0], shape[1] // 3, 3)
        what = f"its array of shape {shape} may be joints of shape {joints}, flattened"
        hint = f"If so, save it with reshape{joints}; save rotations as npz with poses and trans"
    raise PoiseError(what, path, hint, code="array-unclear")


def looks_like_openpose(head: bytes) -> bool:
    """Whether a file's first bytes are one frame of OpenPose's JSON."""
    return head[:1] == b"{" and (b"pose_keypoints_2d" in head or b'"people"' in head[:200])


def refuse_openpose(path: Path, options: ReadOptions) -> NoReturn:
    """OpenPose's JSON holds the image coordinates of one frame of one camera."""
    raise PoiseError(
        "it holds the 2D keypoints of one camera's image (OpenPose)",
        path,
        FLAT_HINT,
        code="flat-keypoints",
    )


def refuse_folder(path: Path) -> NoReturn:
    """A folder is no motion; one of OpenPose's JSON files is told from others."""
    refuse_flat_folder(path)
    raise PoiseError(
        "this is a folder, not a motion file", path, "Name one file in it", code="is-folder"
    )


def refuse_flat_folder(path: Path) -> None:
    """Refuses a folder of OpenPose's JSON files, told by one among its first `LOOKED_AT` files."""
    few = itertools.islice(path.rglob("*"), LOOKED_AT)
    first = min((f for f in few if f.suffix == ".json" and f.is_file()), default=None)
    if first is not None:
        with first.open("rb") as file:
            if looks_like_openpose(file.read(4096).lstrip()):
                what = "this folder holds the 2D keypoints of one camera (OpenPose), which have no depth"
                raise PoiseError(
                    what,
                    path,
                    f"{FLAT_HINT}; or estimate 3D poses from the video",
                    code="flat-keypoints",
                )
