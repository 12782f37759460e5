"""Keypoints in NumPy arrays: Poise's keypoint npz, results of the motion diffusion model, HumanML3D."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.arrays import numeric, one_number, require, text_of
from poise.formats.guess import UPS
from poise.formats.one_person import MOST_PEOPLE, one_person
from poise.formats.point_raw import RawPoints
from poise.formats.raw import UNSTATED, ReadOptions
from poise.formats.refused import FLAT_HINT
from poise.formats.text import MAX_JOINTS, shown
from poise.motion.clip import check_rate

HUMANML3D = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle"),
    *("right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
"""The 22 joints of HumanML3D (Guo et al. 2022), in the order of its arrays."""
_HUMANML3D_FPS = 20.0
#: Rates of arrays that state none, frames/s, the usual one first.
_UNSTATED = (_HUMANML3D_FPS, 30.0)
#: What joints' names are called in files.
_NAMES = ("names", "joint_names")
_HANDS = ("left_hand", "right_hand")


def is_joints(shape: tuple[int, ...], dtype: np.dtype[Any]) -> bool:
    """Whether one array holds the places of SMPL's joints: `(T, 22, 3)`, or `(T, 24, 3)` with hands;
    of several people `(T, P, 22, 3)`."""
    one = len(shape) == 3 or (len(shape) == 4 and 0 < shape[1] <= MOST_PEOPLE < shape[0])
    return dtype.kind == "f" and one and shape[-2:] in ((22, 3), (24, 3))


def joint_points(array: np.ndarray, path: Path, options: ReadOptions = UNSTATED) -> RawPoints:
    """Places of SMPL's joints in metres; the vertical is guessed unless stated.

    22 joints without a stated rate have HumanML3D's, 20 frames per second; for 24 there is no usual one.

    Raises:
        PoiseError: 24 joints without a stated rate.
    """
    array, people = one_person(array, 3, options.take, path)
    names = HUMANML3D + (_HANDS if array.shape[1] == len(HUMANML3D) + 2 else ())
    fps, notes = options.fps, people
    if fps is None:
        if len(names) != len(HUMANML3D):
            raise PoiseError(
                "an array of joints states no frame rate",
                path,
                "State it with --fps F",
                code="rate-missing",
            )
        fps = _HUMANML3D_FPS
        notes.append("The file states no frame rate: 20 taken, as HumanML3D has it (--fps F)")
    positions = numeric({"joints": array}, "joints", (None, len(names), 3), path)
    return RawPoints(
        "joints", path, names, positions, fps, 1.0, None, notes=tuple(notes),
        unit_note="The file states no unit: metres taken (--unit METRES)",
        rates=_UNSTATED if options.fps is None else (),
    )  # fmt: skip


def is_named_joints(data: Mapping[str, Any]) -> bool:
    """Whether named arrays are the places of joints with their rate."""
    return "joints" in data and "fps" in data


def named_joint_points(
    data: Mapping[str, Any], path: Path, options: ReadOptions = UNSTATED
) -> RawPoints:
    """`joints (T, 22, 3)` or `(T, 24, 3)` and `fps`, read as one array of joints is; with `names (J)` or
    `joint_names`, any `joints (T, J, 3)`, each of which is what its name says.

    Raises:
        PoiseError: another number of joints, names that do not fit them, or what `numeric` refuses.
    """
    if named := next((key for key in _NAMES if key in data), None):
        own: dict[str, Any] = {
            key: data[key] for key in ("fps", "confidence", "unit_m", "up_axis") if key in data
        }
        as_points = {**own, "positions": data["joints"], "names": data[named]}
        return replace(array_points(as_points, path, options), format="joints")
    table, people = one_person(np.asarray(data["joints"]), 3, options.take, path)
    joints = numeric({"joints": table}, "joints", (None, None, 3), path)
    if not is_joints(joints.shape, joints.dtype):
        raise PoiseError(
            f"its array 'joints' has the shape {joints.shape}", path,
            "Joints of SMPL are (T, 22, 3) or (T, 24, 3); others need names (J)", code="wrong-shape",
        )  # fmt: skip
    fps = one_number(data, "fps", path) if options.fps is None else options.fps
    check_rate(fps, path)
    points = joint_points(joints, path, replace(options, fps=fps))
    return replace(points, notes=(*people, *points.notes))


def is_points(data: Mapping[str, Any]) -> bool:
    """Whether named arrays are keypoints: `positions` and `names`, and no rotations."""
    return "positions" in data and "names" in data and not {"rot", "rotations", "quats"} & set(data)


def array_points(data: Mapping[str, Any], path: Path, options: ReadOptions = UNSTATED) -> RawPoints:
    """`positions (T, K, 3)` (NaN where missing), `names (K)`, `fps`; optional `confidence (T, K)`,
    `unit_m` and `up_axis`.

    Raises:
        PoiseError: an array that lacks or has another shape; no frame rate; 2D positions.
    """
    require(data, ("positions", "names"), path, "a keypoint file")
    positions = np.asarray(data["positions"])
    if positions.ndim == 3 and positions.shape[-1] == 2:
        raise PoiseError(
            f"its positions have the shape {positions.shape}: they are 2D",
            path,
            FLAT_HINT,
            code="flat-keypoints",
        )
    table, notes = one_person(positions, 3, options.take, path)
    positions = numeric({"positions": table}, "positions", (None, None, 3), path)
    names = tuple(text_of(x).strip() for x in np.ravel(np.asarray(data["names"])))
    if len(names) != positions.shape[1] or not all(names) or len(names) > MAX_JOINTS:
        raise PoiseError(
            f"it has {len(names)} names and {positions.shape[1]} keypoints; each needs a name",
            path,
            code="count-differs",
        )
    fps = options.fps
    if fps is None:
        if "fps" not in data:
            raise PoiseError(
                "the arrays state no frame rate", path, "Add fps, or give --fps F", code="rate-missing"
            )
        fps = one_number(data, "fps", path)
        check_rate(fps, path)
    unit = one_number(data, "unit_m", path) if "unit_m" in data else None
    up = text_of(data["up_axis"]).upper() if "up_axis" in data else None
    if unit is not None and not unit > 0:
        raise PoiseError(f"unit_m must be above 0, got {unit:g}", path, code="out-of-range")
    if up not in (None, *UPS):
        raise PoiseError(
            f"up_axis must be one of {', '.join(UPS)}, got {shown(up or '')}", path, code="unknown-axis"
        )
    scores = None
    if "confidence" in data:
        own, _ = one_person(np.asarray(data["confidence"]), 2, options.take, path)
        scores = numeric({"confidence": own}, "confidence", positions.shape[:2], path)
    return RawPoints("keypoints-npz", path, names, positions, fps, unit, up, scores, notes=tuple(notes))


def is_mdm(data: Mapping[str, Any]) -> bool:
    """Whether named arrays are the results of a motion diffusion model (Tevet et al. 2023)."""
    return "motion" in data and "lengths" in data


def mdm_points(data: Mapping[str, Any], path: Path, options: ReadOptions = UNSTATED) -> RawPoints:
    """One of the motions `motion (N, 22, 3, T)`: HumanML3D's joints, metres, Y up, 20 frames per second.

    The first one, or number `options.take`. `lengths (N)` tells how many of the T frames are its own.
    """
    take = options.take or "0"
    if not take.isdecimal():
        raise PoiseError(
            f"--take must be the number of a motion, got {shown(take)}", path, code="option-malformed"
        )
    index = int(take)
    motion = numeric(data, "motion", (None, len(HUMANML3D), 3, None), path)
    lengths = numeric(data, "lengths", (len(motion),), path)
    if index >= len(motion):
        raise PoiseError(
            f"it holds {len(motion)} motions, there is none with index {index}",
            path,
            code="unknown-take",
        )
    length = lengths[index]
    if not 1 <= length <= motion.shape[-1]:
        raise PoiseError(
            f"motion {index} states {length:g} of {motion.shape[-1]} frames", path, code="length-differs"
        )
    notes = []
    if len(motion) > 1:
        notes.append(f"The file holds {len(motion)} motions: number {index} was read (--take N)")
    if "text" in data:
        texts = np.ravel(np.asarray(data["text"]))
        if index < len(texts) and text_of(texts[index]):
            notes.append(f"It was generated for {shown(text_of(texts[index]))}")
    return RawPoints(
        "mdm",
        path,
        HUMANML3D,
        motion[index, :, :, : int(length)].transpose(2, 0, 1),
        _HUMANML3D_FPS,
        1.0,
        "Y",
        notes=tuple(notes),
    )


#: Root (turn, way in two axes, height), places, turns and velocities of the joints, contacts.
WIDTH = 263
_PLACES, CONTACTS = slice(4, 4 + 3 * 21), slice(259, 263)
#: Heights (m) that a pelvis has on average.
_LOWEST, _HIGHEST = 0.05, 2.5


def is_features(shape: tuple[int, ...], dtype: np.dtype) -> bool:
    """Whether one array holds features of HumanML3D, `(T, 263)`."""
    return len(shape) == 2 and shape[1] == WIDTH and dtype.kind == "f"


def feature_points(table: np.ndarray, path: Path, options: ReadOptions = UNSTATED) -> RawPoints:
    """The joints of features `(T, 263)`, m, Y up; their `CONTACTS` are labels of the feet.

    The root turns about Y by twice the sum of the first feature and goes by the next two in its own
    frame; joints lie about it in that frame.

    Raises:
        PoiseError: features that are normalised, which tell no place.
    """
    x = table.astype(np.float64)
    touch = x[:, CONTACTS]
    # Normalised ones have a mean of 0 and a deviation of 1.
    if not (_LOWEST < np.median(x[:, 3]) < _HIGHEST and touch.min() > -0.5 and touch.max() < 1.5):
        raise PoiseError(
            f"its array of shape {table.shape} holds the features of HumanML3D, but normalised or empty",
            path,
            "Give features * Std.npy + Mean.npy, or the joints recovered from them, (T, 22, 3)",
            code="features-normalised",
        )
    turn = 2.0 * np.concatenate(([0.0], np.cumsum(x[:-1, 0])))
    steps = np.zeros((len(x), 3))
    steps[1:, [0, 2]] = x[:-1, 1:3]
    root = np.cumsum(_turned(steps, turn), axis=0)
    root[:, 1] = x[:, 3]
    about = _turned(x[:, _PLACES].reshape(len(x), -1, 3), turn[:, None])
    about[..., [0, 2]] += root[:, None, [0, 2]]
    joints = np.concatenate((root[:, None], about), 1)
    raw = joint_points(joints, path, options)
    return RawPoints(
        "humanml3d",
        path,
        HUMANML3D,
        raw.positions,
        raw.fps,
        1.0,
        "Y",
        notes=raw.notes,
        rates=raw.rates,
    )


def _turned(v: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Vectors `(..., 3)` turned about Y by `-angle (...)` rad, the inverse of what the features did."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack((c * v[..., 0] - s * v[..., 2], v[..., 1], s * v[..., 0] + c * v[..., 2]), -1)
