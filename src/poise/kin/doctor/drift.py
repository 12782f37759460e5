"""A height that drifts: the floor under the feet rises or sinks steadily, as in motion from video."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from poise.kin.doctor.faults import Fault
from poise.kin.feet.contact import SAME_FLOOR_M
from poise.kin.ground import ALOFT_M
from poise.kin.series import find_runs, gaussian
from poise.motion import Clip

#: A drift of less (m) over the whole clip is none, and so is one of a clip that is shorter (s).
LEAST_M, LEAST_S = 0.1, 0.8
# A body on stairs or a slope is borne at one height for the time of each step. One that drifts moves up
# while it is borne: about as fast (shares of the whole clip's speed) in its usual frame as in the mean.
_USUAL = (0.7, 1.5)
# Share of the frames in which the lowest point keeps to the line, and deviation (s) of the smoothing.
_BORNE, _SMOOTH_S = 0.5, 0.05
#: A spell off the floor that is said to be none by its steady height alone: for so long (s), this fast.
HELD_S, RISES = 0.6, 0.02


class Drift(NamedTuple):
    """speed: m/s, upwards. at_start: m, the drifting floor in frame 0. frames, fps: the clip's."""

    speed: float
    at_start: float
    frames: int
    fps: float

    @property
    def size_m(self) -> float:
        """How far the floor gets over the clip, m."""
        return self.speed * (self.frames - 1) / self.fps

    def heights(self) -> np.ndarray:
        """`(T)` m to take off, so that the floor stays where its line is nearest to zero."""
        line = self.at_start + self.speed * np.arange(self.frames) / self.fps
        stays = line[np.abs(line).argmin()] if line.min() > 0 or line.max() < 0 else 0.0
        return line - stays


def find_drift(low: np.ndarray, fps: float) -> Drift | None:
    """The steady drift of the lowest points `(T)` m of a body, None where there is none.

    The line that the lower half of the points keep to must climb by `LEAST_M`, half of all points must
    lie on it, and in the usual frame on it the point must move as the line does.
    """
    frames = len(low)
    if frames < max(8, LEAST_S * fps):
        return None
    t, on = np.arange(frames) / fps, np.ones(frames, dtype=bool)
    speed = start = 0.0
    for _ in range(8):
        speed, start = np.polyfit(t[on], low[on], 1)
        over = low - (start + speed * t)
        # Swinging and flying bodies are above their floor, never below.
        on = over <= np.quantile(over, 0.6)
    drift = Drift(float(speed), float(start), frames, fps)
    if abs(drift.size_m) < LEAST_M:
        return None
    over = low - (start + speed * t)
    over = over - np.median(over[on])
    near = np.abs(over) < SAME_FLOOR_M
    if near.mean() < _BORNE or np.quantile(over, 0.02) < -2.0 * SAME_FLOOR_M:
        return None
    window = gaussian(_SMOOTH_S * fps)
    smooth = np.convolve(np.pad(low, len(window) // 2, mode="edge"), window, "valid")
    steps = np.diff(smooth) * fps
    usual = float(np.median(steps[near[1:] & near[:-1]])) / drift.speed
    return drift if _USUAL[0] < usual < _USUAL[1] else None


def mend_drift(clip: Clip, low: np.ndarray) -> Clip:
    """The clip without the steady drift of its floor, which its lowest points `low (T)` m tell."""
    drift = find_drift(low, clip.fps)
    if drift is None:
        return clip
    return clip.replaced(root_pos=clip.root_pos - drift.heights()[:, None] * np.array([0.0, 0.0, 1.0]))


def drift_faults(low: np.ndarray, fps: float, flying: np.ndarray) -> list[Fault]:
    """The steady drift, or else the spells off the floor in which the body rises or sinks steadily.

    Args:
        low: `(T)` m, the body's lowest point. flying: `(T)`, where it falls freely.
    """
    drift = find_drift(low, fps)
    if drift is not None:
        way = "rises" if drift.speed > 0 else "sinks"
        told = f"the floor under its steps {way} steadily by {abs(drift.size_m) * 100:.0f} cm"
        return [Fault("float", "", 0, len(low) - 1, abs(drift.size_m) * 100, told)]
    out = []
    for first, last in find_runs((low > ALOFT_M) & ~flying, 0):
        if last - first + 1 < HELD_S * fps:
            continue
        part = low[first : last + 1]
        speed = float(np.median(np.diff(part))) * fps
        whole = float(part[-1] - part[0]) / (last - first) * fps
        if abs(speed) > RISES and whole * speed > 0 and 0.5 < abs(whole / speed) < 2.0:
            told = "it goes up or down there while something bears it"
            out.append(Fault("float", "", first, last, float(part.max()) * 100, told))
    return out
