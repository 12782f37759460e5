"""Guesses about what motion files do not state, each with its evidence in one sentence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.io.text import listed
from poise.spatial import quat_angle, quat_conj, quat_mul

UPS = ("Y", "Z", "X", "-Y", "-Z", "-X")
"""Verticals that a file may have; with "-" the axis points down."""

ASF_UNIT_M = 0.0254 / 0.45
"""Metres in the unit of the CMU library's ASF files (`length 0.45`, inches)."""

UNITS = {
    "metres": 1.0,
    "centimetres": 0.01,
    "millimetres": 0.001,
    "inches": 0.0254,
    "decimetres": 0.1,
    "feet": 0.3048,
    "ASF units": ASF_UNIT_M,
}
# How usual a unit is in files; those of the Acclaim system are the CMU library's as a rule.
_USUAL = {"inches": 0.1, "ASF units": 0.03, "decimetres": 0.03, "feet": 0.02}
_USUAL_ASF = {**_USUAL, "ASF units": 1.0}
# Densities (per m) of heights in motion files: grown-ups about 1.72 m, some children, few others.
_GROWN_M, _SPREAD_M = 1.72, 0.12
_BANDS = (
    *(((0.75, 1.5), 0.07), ((0.6, 0.75), 0.02), ((0.5, 0.6), 0.004)),
    *(((2.0, 2.3), 0.004), ((2.3, 3.0), 0.001)),
)
# A unit that is so many times likelier than the next one is sure.
_CLEARLY = 20.0
_GUESS_BAND = (0.5, 3.0)
_STATED_BAND = (0.3, 4.0)

_REST_ANGLE = np.radians(15.0)
_TELEPORT_SPEED = 6.0


@dataclass(frozen=True)
class Guess:
    """A value and the sentence that tells why, empty where the value is a stated one."""

    value: float | str
    note: str = ""


def stated_unit(height: float, unit_m: float, path: Path) -> Guess:
    """The unit the user stated, refused if the person's size becomes absurd."""
    size = height * unit_m
    if _STATED_BAND[0] <= size <= _STATED_BAND[1]:
        return Guess(unit_m)
    best, metres = _ranked(height)[0]
    raise PoiseError(
        f"with {unit_m:g} m per unit the person would be {_size(size)} tall",
        path,
        f"Give another --unit METRES_PER_UNIT; {best} ({metres:.6g}) would make it "
        f"{_size(height * metres)}",
    )


def guess_unit(height: float, how: str, hint: float | None, path: Path, form: str = "") -> Guess:
    """Metres per unit from the skeleton's height in file units.

    A unit that the file itself suggests (`hint`) is kept if it makes a plausible person. Otherwise the
    one that is usual in the format `form` and makes a person of a usual size; one that is about as
    likely is named.
    """
    if hint is not None and _GUESS_BAND[0] <= height * hint <= _GUESS_BAND[1]:
        return Guess(
            hint,
            f"One file unit is taken as {hint:.6g} m by the file's `length` entry: the person is then "
            f"{height * hint:.2f} m tall ({how})",
        )
    ranked = _ranked(height, how, form)
    best, metres = ranked[0]
    size = height * metres
    if not _GUESS_BAND[0] <= size <= _GUESS_BAND[1]:
        raise PoiseError(
            f"the person is {height:.4g} file units tall, which is no human size in any known unit: "
            f"the nearest guess, {best}, makes it {_size(size)}",
            path,
            "State the unit with --unit METRES_PER_UNIT",
        )
    told = f"The file states no unit: {best} taken, which make the person {size:.2f} m tall ({how})"
    other, metres_of_other = ranked[1]
    if _CLEARLY * _likely(height, other, how, form) > _likely(height, best, how, form):
        told += (
            f"; uncertain, since {other} would make it {height * metres_of_other:.2f} m "
            f"(--unit {metres_of_other:.6g})"
        )
    return Guess(metres, told)


def _likely(height: float, unit: str, how: str, form: str) -> float:
    """How likely a unit is for a height in file units: how usual it is, times how many are so tall."""
    size = height * UNITS[unit]
    spread = _SPREAD_M if "bones" in how else 2.0 * _SPREAD_M
    grown = np.exp(-0.5 * ((size - _GROWN_M) / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
    rare = sum(density for (low, high), density in _BANDS if low <= size <= high)
    if not _GUESS_BAND[0] <= size <= _GUESS_BAND[1]:
        # Beyond all people the nearest unit is named.
        return 1e-30 * float(np.exp(-abs(np.log(size / _GROWN_M))))
    return (_USUAL_ASF if form == "asf-amc" else _USUAL).get(unit, 1.0) * float(grown + rare + 1e-6)


def _ranked(height: float, how: str = "bones", form: str = "") -> list[tuple[str, float]]:
    """The units with their metres, the likeliest for a height in file units first."""
    order = sorted(UNITS, key=lambda unit: -_likely(height, unit, how, form))
    return [(unit, UNITS[unit]) for unit in order]


def _size(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 0.1 else f"{metres * 1e3:.3g} mm"


def inserted_rest_frames(rot: np.ndarray) -> tuple[int, str]:
    """How many frames of a rest pose were put before the motion, and a sentence about them; 0 if none.

    Frame 0 is one when its root is unturned and its joints are near their rest rotations, and from it to
    frame 1 the root (or the mean joint) turns far more than from frame to frame afterwards. Some
    converters smooth over that jump: frames in which the joints go on easing out of it, by ever smaller
    steps that are all far greater than usual, are no motion either.
    """
    if len(rot) < 4:
        return 0, ""
    q = torch.tensor(rot[:40], dtype=torch.float64)
    steps = quat_angle(quat_mul(quat_conj(q[:-1]), q[1:])).numpy()
    from_rest = quat_angle(q[0]).numpy()
    if from_rest[0] > np.radians(0.5) or from_rest.mean() > _REST_ANGLE:
        return 0, ""
    root, joints = steps[:, 0], steps[:, 1:].mean(-1) if steps.shape[1] > 1 else steps[:, 0]
    # What is usual shows behind the frames that ease, which turn fast themselves.
    usual_root, usual = (
        min(np.median(x[1:12]), np.median(x[20:]) if len(x) > 24 else np.inf) for x in (root, joints)
    )
    root_jumps = root[0] > 6.0 * usual_root + np.radians(5.0)
    joints_jump = joints[0] > 6.0 * usual + np.radians(2.0)
    if not (root_jumps or joints_jump):
        return 0, ""
    easing = 0
    if len(joints) > 24:
        large = joints[1:20] > 2.0 * np.median(joints[20:]) + np.radians(0.2)
        falling = np.concatenate(([True], joints[2:20] < joints[1:19]))
        easing = int(np.cumprod(large & falling).sum())
    if not easing:
        return 1, "Frame 0 is a rest pose that was put before the motion; it was dropped"
    return 1 + easing, (
        f"Frame 0 is a rest pose that was put before the motion, and up to frame {easing} the joints "
        f"ease out of it; these {1 + easing} frames were dropped"
    )


def root_jumps(root_pos: np.ndarray, fps: float) -> list[tuple[int, float]]:
    """(frame, metres) wherever the root path `(T, 3)` m gets in one step farther than a body can.

    Such a step exceeds 6 m/s and five times the usual step of the frames around it.
    """
    step = np.linalg.norm(np.diff(root_pos, axis=0), axis=-1)
    fast = step * fps > _TELEPORT_SPEED
    if len(step) < 3 or not fast.any():
        return []
    half = max(3, round(0.25 * fps))
    padded = np.pad(step, half, mode="reflect" if len(step) > half else "edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    usual = np.concatenate([np.median(part, axis=-1) for part in np.array_split(windows, 16)])
    found = np.flatnonzero(fast & (step > 5.0 * usual))
    return [(int(f) + 1, float(step[f])) for f in found]


def teleports(root_pos: np.ndarray, fps: float) -> list[str]:
    """A sentence about the `root_jumps`: frames, metres."""
    found = root_jumps(root_pos, fps)
    if not found:
        return []
    jumps = listed((f"{frame} ({size:.2f} m)" for frame, size in found), 12)
    return [f"The root jumps at frame{'' if len(found) == 1 else 's'} {jumps}; the jumps were kept"]
