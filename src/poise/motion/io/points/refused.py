"""2D keypoints cannot become a clip: what to give instead."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.points.raw import FLAT_HINT
from poise.motion.io.raw import ReadOptions


def looks_like_openpose(head: bytes) -> bool:
    """Whether a file's first bytes are one frame of OpenPose's JSON."""
    return head[:1] == b"{" and (b"pose_keypoints_2d" in head or b'"people"' in head[:200])


def refuse_openpose(path: Path, options: ReadOptions) -> Clip:
    """OpenPose's JSON holds the image coordinates of one frame of one camera."""
    raise PoiseError("it holds the 2D keypoints of one camera's image (OpenPose)", path, FLAT_HINT)


def refuse_folder(path: Path) -> NoReturn:
    """A folder is no motion; one of OpenPose's JSON files is told from others."""
    first = next(iter(sorted(path.glob("*.json"))), None)
    if first is not None and first.is_file():
        with first.open("rb") as file:
            if looks_like_openpose(file.read(4096).lstrip()):
                raise PoiseError(
                    "this folder holds the 2D keypoints of one camera (OpenPose)", path, FLAT_HINT
                )
    raise PoiseError("this is a folder, not a motion file", path, "Name one file in it")
