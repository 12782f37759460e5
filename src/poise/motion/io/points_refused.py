"""Files that come beside keypoints and cannot become a clip, each with what to give instead."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.points import FLAT_HINT
from poise.motion.io.raw import Options
from poise.motion.io.text import listed


def looks_like_openpose(head: bytes) -> bool:
    """Whether a file's first bytes are one frame of OpenPose's JSON."""
    return head[:1] == b"{" and (b"pose_keypoints_2d" in head or b'"people"' in head[:200])


def looks_like_opensim(head: bytes) -> bool:
    """Whether a file's first bytes are the header of OpenSim's `.mot` or `.sto`."""
    low = head[:2000].lower()
    return b"endheader" in low and (b"indegrees" in low or b"ncolumns" in low)


def refuse_openpose(path: Path, options: Options) -> Clip:
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


def refuse_opensim(path: Path, options: Options) -> Clip:
    """OpenSim's angles belong to one model; the points they were made from stand beside them."""
    beside = sorted(p.name for p in path.parent.glob("*.trc"))
    hint = "Give the TRC file that they were computed from"
    if beside:
        hint += f": {listed(beside, 4)} beside it"
    raise PoiseError(
        "it holds the joint angles of an OpenSim model, which mean nothing without that model",
        path,
        hint,
    )
