"""The features of HumanML3D (Guo et al. 2022): 263 numbers a frame, of which joints are recovered."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.motion.io.points.arrays import HUMANML3D, joint_points
from poise.motion.io.points.raw import RawPoints
from poise.motion.io.raw import UNSTATED, ReadOptions

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
