"""Tracks of a body without the noise of the estimator that found them; tracks without any stay.

Noise is told as that of joints is (`motion.spectrum`), and by the bones: they keep their lengths when a
body moves, whatever it does, and do not when each keypoint trembles by itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from poise.motion.points.labels import SIDES
from poise.motion.smoothing import faded, pieces, smoothed, tremble_of
from poise.motion.spectrum import (
    HIGHEST_HZ,
    LINES,
    RESOLVED,
    SHORTEST,
    TREMBLES,
    WHITE_MM,
    Spectrum,
    white_mm,
)

#: Bones of which both ends are needed places.
BONES = (
    ("left_hip", "right_hip"),
    *((f"{s}_{a}", f"{s}_{b}") for s in SIDES for a, b in pairwise(("hip", "knee", "ankle"))),
    *((f"{s}_{a}", f"{s}_{b}") for s in SIDES for a, b in pairwise(("shoulder", "elbow", "wrist"))),
)
#: Below this (Hz) people have tones of their own, and a tremble has to stand in the bones' lengths: that
#: of two ends that tremble by themselves has a third of their variances, and is to have this share of it
#: on average.
SURE_HZ, IN_BONES = 3.5, 0.4
#: With a smaller share the bones stay as they are: a rigid body moves so, if it trembles, as joints do.
RIGID = 0.05
#: A smaller tremble (mm) at a frequency is none.
LEAST_MM = 3.0
#: A frequency is clear at which the bones change by this times the median power.
CLEAR = 6.0


@dataclass(frozen=True)
class Tremble:
    """A tremble that was taken off: mm (rms over places), and Hz, None from frame to frame."""

    size_mm: float
    hz: float | None

    @property
    def how(self) -> str:
        """Its frequency in words, such as "at 5.0 Hz"."""
        return "from frame to frame" if self.hz is None else f"at {self.hz:.1f} Hz"


def still(tracks: Mapping[str, np.ndarray], fps: float) -> tuple[dict[str, np.ndarray], Tremble | None]:
    """The tracks `(T, 3)` m of the places of a body without their noise, and what it was; None where
    there is none, and the tracks as they are. What is long is told and smoothed by pieces."""
    names = list(tracks)
    places = np.stack([tracks[name] for name in names], 1)
    frames = len(places)
    bones = [(names.index(a), names.index(b)) for a, b in BONES]
    out, worst = places.copy(), None
    for here in pieces(frames, fps):
        found = _piece(places[here], fps, bones)
        if found is None:
            continue
        share = faded(here, frames, fps)[:, None, None]
        out[here] += share * (found[0] - places[here])
        worst = max(found[1], worst or found[1], key=_size)
    if worst is None:
        return dict(tracks), None
    return {name: out[:, k] for k, name in enumerate(names)}, worst


def _piece(
    places: np.ndarray, fps: float, bones: list[tuple[int, int]]
) -> tuple[np.ndarray, Tremble] | None:
    """A piece `(T, K, 3)` without its noise and that, None where it has none."""
    frames, count = places.shape[:2]
    if frames < SHORTEST:
        return None
    groups, calm = np.repeat(np.arange(count), 3), places.reshape(frames, -1)
    found: Tremble | None = None
    for _ in range(LINES):
        spectrum = Spectrum.of(calm, fps, groups)
        # Of a tremble that is gone the bones keep what their turning made of it, at other frequencies.
        told = _tone(
            spectrum, calm.reshape(places.shape), bones, HIGHEST_HZ if found is None else SURE_HZ
        )
        if told is None:
            break
        hz, size = told
        found = max(found or Tremble(0.0, hz), Tremble(1e3 * math.sqrt(size), hz), key=_size)
        calm = calm - tremble_of(calm, groups, spectrum, hz, size)[0]
    white = white_mm(places, fps) if found is None else 0.0
    if found is None and white < WHITE_MM:
        return None
    floor = Spectrum.of(calm, fps, groups).floor()
    calm = smoothed(calm, fps, groups, floor)
    return calm.reshape(places.shape), found or Tremble(white, None)


def _tone(
    spectrum: Spectrum, places: np.ndarray, bones: list[tuple[int, int]], top: float
) -> tuple[float, float] | None:
    """The frequency (Hz) at which the keypoints tremble, and the variance of that (m^2, all axes); None
    where they do not. Up to `top` (Hz) the bones alone may tell it."""
    hz = spectrum.tremble()
    lengths = np.stack([np.linalg.norm(places[:, a] - places[:, b], axis=-1) for a, b in bones], -1)
    of_bones = Spectrum.of(lengths, spectrum.fps, np.arange(len(bones)))
    for one in (hz, _clearest(of_bones, top)):
        if one is None:
            continue
        moves, changes = spectrum.tone(one)[0], of_bones.tone(one)[0]
        both = np.array([moves[a] + moves[b] for a, b in bones]) / 3.0
        in_bones = float(np.minimum(changes / np.maximum(both, 1e-300), 2.0).mean())
        if in_bones >= IN_BONES:
            # The body's own motion at that frequency is no tremble.
            size = min(1.5 * float(changes.mean()), float(moves.mean()))
        elif one >= SURE_HZ and in_bones >= RIGID:
            size = float(moves.mean())
        else:
            continue
        return (one, size) if 1e3 * math.sqrt(size) >= LEAST_MM else None
    return None


def _clearest(lengths: Spectrum, top: float) -> float | None:
    """The frequency (Hz) at which the bones' lengths change most, None where they have no such."""
    low, high = max(TREMBLES[0][0], RESOLVED * lengths.width), 0.42 * lengths.fps
    band = (lengths.hz >= low) & (lengths.hz <= high)
    power = lengths.power[band]
    if not len(power) or not power.any():
        return None
    every = (power / np.maximum(power.mean(0), 1e-300)).mean(1)
    peak = int(every.argmax())
    hz = float(lengths.hz[band][peak])
    clear = every[peak] >= CLEAR * np.median(every) and 0 < peak < len(every) - 1
    return hz if clear and hz < top else None


def _size(tremble: Tremble) -> float:
    return tremble.size_mm
