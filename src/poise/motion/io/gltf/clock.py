"""The rate at which all channels of a glTF animation are read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from poise.errors import PoiseError
from poise.motion.clip import check_poses
from poise.motion.io.gltf.file import GltfFile
from poise.motion.io.gltf.tracks import Take, Track
from poise.motion.io.text import MAX_VALUE

_SLOW_HZ = 12.0
_USUAL_HZ = 30.0
_FAST_HZ = 1000.0
# Keys off any grid are read at the next of these rates.
_UNEVEN_HZ = (30.0, 60.0, 120.0, 240.0)
# Rates that exporters write as float32 times; NTSC ones lie 0.1 % below the whole number.
_RATE_SLACK = 2e-4
_SAME_TIME = 1e-3


def clock(
    take: Take, tracks: Sequence[Track], fps: float | None, file: GltfFile, notes: list[str]
) -> tuple[np.ndarray, float]:
    """The times `(T,)` s at which all channels are read, and frames per second.

    The rate is the stated one, that which Poise wrote beside the keys, or the most common spacing
    of the keys. Times that are a key up to float32 noise become that key exactly.
    """
    if not tracks:
        raise PoiseError("the animation moves no joint of the figure", file.path)
    inputs = {id(t.times): t.times for t in tracks}.values()
    start, end = min(t[0] for t in inputs), max(t[-1] for t in inputs)
    if end <= start:
        raise PoiseError("the animation has a single key, which is no motion", file.path)
    own = number_of(take.extras.get("fps"))
    if fps is not None:
        rate = fps
    elif own is not None and own < _FAST_HZ and _on_grid(list(inputs), start, 1.0 / own):
        rate = own
    else:
        rate = _guessed_rate(list(inputs), start, notes)
    # Times are float32 numbers; the last frame may lie that much before its place.
    noise = 2 * float(np.spacing(np.float32(max(abs(start), abs(end)))))
    count = int(np.floor((end - start + noise) * rate + 0.02)) + 1
    check_poses(count, len(tracks), file.path)
    when = start + np.arange(count) / rate
    keys = np.unique(np.concatenate(list(inputs)))
    near = np.clip(np.searchsorted(keys, when), 1, max(1, len(keys) - 1))
    nearest = np.where(
        np.abs(keys[near] - when) < np.abs(keys[near - 1] - when), keys[near], keys[near - 1]
    )
    same = np.abs(nearest - when) <= _SAME_TIME / rate + noise
    return np.where(same, nearest, when), rate


def number_of(value: object) -> float | None:
    """A number above 0 from `extras`, None for anything else there."""
    return float(value) if isinstance(value, int | float) and 0 < value < MAX_VALUE else None


def _spacings(inputs: list[np.ndarray]) -> np.ndarray:
    steps = np.concatenate([np.diff(t) for t in inputs])
    return steps[steps > 1.0 / _FAST_HZ]


def _on_grid(inputs: list[np.ndarray], start: float, step: float) -> bool:
    """Whether all keys lie on `start + k step`, up to a twentieth of a step."""
    return all(np.abs((t - start) / step - np.round((t - start) / step)).max() < 0.05 for t in inputs)


def _guessed_rate(inputs: list[np.ndarray], start: float, notes: list[str]) -> float:
    steps = _spacings(inputs)
    if not len(steps):
        notes.append(
            f"The keys lie too close to tell a frame rate; {_USUAL_HZ:g} frames per second taken"
        )
        return _USUAL_HZ
    # Spacings that differ by float32 noise fall into one class of a hundredth of an octave.
    classes, counts = np.unique(np.round(np.log2(steps) * 100), return_counts=True)
    common = steps[np.round(np.log2(steps) * 100) == classes[counts.argmax()]]
    longest = max(inputs, key=len)
    step = float(np.median(common))
    even = longest[-1] - longest[0]
    whole = round(even / step)
    if whole == len(longest) - 1 and whole > 0:
        # Evenly spaced keys tell the spacing best from first to last.
        step = float(even / whole)
    rate = _round_rate(1.0 / step)
    if rate < _SLOW_HZ:
        notes.append(
            f"Most keys stand {step:.4g} s apart; they were read at {_USUAL_HZ:g} frames per second"
        )
        return _USUAL_HZ
    if not _on_grid(inputs, start, 1.0 / rate):
        rate = next((r for r in _UNEVEN_HZ if r >= rate * 0.99), rate)
        notes.append(f"The keys are not evenly spaced; they were read at {rate:.6g} frames per second")
    return rate


def _round_rate(rate: float) -> float:
    """The whole or NTSC frame rate that lies within float32 noise, else the rate itself."""
    whole = round(rate)
    for known in (float(whole), whole * 1000.0 / 1001.0):
        if whole > 0 and abs(rate / known - 1.0) < _RATE_SLACK:
            return known
    return rate
