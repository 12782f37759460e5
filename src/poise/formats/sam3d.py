"""Results of SAM 3D Body: 70 points of a person for each picture, in the frame of the camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.arrays import numeric, one_number
from poise.formats.one_person import MOST_PEOPLE, one_person
from poise.formats.point_raw import RawPoints
from poise.formats.raw import UNSTATED, ReadOptions
from poise.formats.text import MAX_JSON_BYTES, json_value, read_bytes, shown
from poise.motion.clip import check_poses, check_rate

POINTS, PLACE, COUNT = "pred_keypoints_3d", "pred_cam_t", 70
#: The first of the Momentum Human Rig's 70 points, and columns of others that tell a body; the rest are
#: of fingers and elbows.
_FIRST = (
    *("nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder"),
    *("left_elbow", "right_elbow", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle"),
    *("right_ankle", "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe"),
    "right_heel",
)
_COLUMNS = {name: k for k, name in enumerate(_FIRST)} | {"right_wrist": 41, "left_wrist": 62, "neck": 69}
#: Arrays that turn joints of that rig, which only its model knows the lengths of.
_TURNS = ("mhr_model_params", "body_pose_params")
#: Names under which a picture's people are listed.
_PEOPLE = ("outputs", "persons", "people")
_ASK = "Save pred_keypoints_3d and pred_cam_t of each frame"


def is_sam3d(data: Mapping[str, Any]) -> bool:
    """Whether named arrays are results of SAM 3D Body of all frames."""
    if POINTS in data:
        return np.ndim(data[POINTS]) > 2
    return any(name in data for name in _TURNS)


def sam3d_points(data: Mapping[str, Any], path: Path, options: ReadOptions = UNSTATED) -> RawPoints:
    """`pred_keypoints_3d (T, 70, 3)` m from the body's root and `pred_cam_t (T, 3)` m, the root in the
    camera's frame; `fps` where it is there. NaN where nobody was seen.

    Raises:
        PoiseError: turns of the rig without places; no frame rate; another shape.
    """
    if POINTS not in data:
        what = "it holds turns of the Momentum Human Rig, whose bones no file of results states"
        raise PoiseError(what, path, _ASK, code="key-missing")
    table, notes = one_person(np.asarray(data[POINTS]), 3, options.take, path)
    pos = numeric({POINTS: table}, POINTS, (None, COUNT, 3), path)
    if PLACE in data:
        place, _ = one_person(np.asarray(data[PLACE]), 2, options.take, path)
        pos = pos + numeric({PLACE: place}, PLACE, (len(pos), 3), path)[:, None]
        notes.append("SAM 3D Body's points in the camera's frame: a camera that moves or tilts stays in")
    else:
        notes.append("SAM 3D Body's points without pred_cam_t: the body stays in its place")
    fps = options.fps
    if fps is None:
        if "fps" not in data:
            hint = "Give that of the video: --fps F"
            raise PoiseError("the arrays state no frame rate", path, hint, code="rate-missing")
        fps = one_number(data, "fps", path)
        check_rate(fps, path)
    pos = pos[:, list(_COLUMNS.values())]
    names = tuple(_COLUMNS)
    # A camera's Y points down; who turned it over is believed.
    head, foot = names.index("nose"), names.index("left_ankle")
    seen = pos[~np.isnan(pos[:, head, 1] + pos[:, foot, 1])]
    over = len(seen) and float(np.median(seen[:, head, 1] - seen[:, foot, 1])) > 0
    return RawPoints("sam3d", path, names, pos, fps, 1.0, "Y" if over else "-Y", notes=tuple(notes))


def stacked(value: Any, take: str | None, path: Path) -> dict[str, Any] | None:
    """The arrays of all frames, from a list (or dict) with the results of each picture, as
    `process_one_image` gives them: a dict for each person, or a list of such dicts. None where it is
    no such thing.

    One person is followed: the one of number `take` (0) where people are first seen, and from then on
    who is nearest.

    Raises:
        PoiseError: nobody has that number.
    """
    frames = _frames(value)
    first = next((people for f in frames if (people := _people(f, path))), None)
    if first is None:
        return None
    check_poses(len(frames), COUNT, path)
    number = take or "0"
    if not number.isdecimal() or int(number) >= len(first):
        what = f"it holds {len(first)} people, and none is number {shown(number)}"
        raise PoiseError(what, path, "Give a number from 0", code="unknown-take")
    points, places = np.full((len(frames), COUNT, 3), np.nan), np.full((len(frames), 3), np.nan)
    last = first[int(number)]
    for t, frame in enumerate(frames):
        if people := _people(frame, path):
            last = min(people, key=lambda one: _apart(one, last))
            points[t], places[t] = last
    out: dict[str, Any] = {POINTS: points}
    if not (np.nan_to_num(places) == 0).all():
        out[PLACE] = places
    told = value.get("video_info", value) if isinstance(value, Mapping) else {}
    if isinstance(told, Mapping) and isinstance(told.get("fps"), int | float):
        out["fps"] = told["fps"]
    return out


def _apart(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float:
    return float(np.linalg.norm((one[0] + one[1]) - (other[0] + other[1])))


def _frames(value: Any) -> list[Any]:
    """The results of the pictures, in their order."""
    if isinstance(value, Mapping):
        value = value.get("frames", value)
    if isinstance(value, Mapping):
        return [v for v in value.values() if isinstance(v, list | Mapping)]
    return value if isinstance(value, list) else []


def _people(frame: Any, path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points `(70, 3)` and place `(3,)` of each person of a picture."""
    if isinstance(frame, Mapping):
        frame = next((frame[name] for name in _PEOPLE if name in frame), [frame])
    out: list[tuple[np.ndarray, np.ndarray]] = []
    for one in frame[:MOST_PEOPLE] if isinstance(frame, list) else ():
        if isinstance(one, Mapping) and POINTS in one:
            points = numeric(one, POINTS, (COUNT, 3), path)
            out.append((points, numeric(one, PLACE, (3,), path) if PLACE in one else np.zeros(3)))
    return out


def looks_like_sam3d(head: bytes) -> bool:
    """Whether a file's first bytes are SAM 3D Body's results as JSON."""
    begins = head.removeprefix(b"\xef\xbb\xbf").lstrip()[:1]
    return begins in (b"[", b"{") and b'"pred_' in head


def json_points(path: Path, options: ReadOptions) -> RawPoints:
    """Results of SAM 3D Body in JSON, see `stacked`; or all frames at once, see `sam3d_points`."""
    value = json_value(read_bytes(path, MAX_JSON_BYTES), path)
    if isinstance(value, Mapping) and is_sam3d(value):
        return sam3d_points(value, path, options)
    data = stacked(value, options.take, path)
    if data is None:
        what = "the JSON holds no results of SAM 3D Body for each frame"
        raise PoiseError(what, path, _ASK, code="key-missing")
    return sam3d_points(data, path, options)
