"""Rivals on dirty motion: filters, and a foot lock that is told the contacts. A part of
`repair.py`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.signal import butter, savgol_filter, sosfiltfilt

from poise.body import find_anatomy
from poise.errors import PoiseError
from poise.kinematics.hold import Lead, led
from poise.motion import Clip
from poise.motion.smoothing import find_runs

CUTOFFS = (0.5, 0.7, 1, 1.3, 1.6, 2, 2.5, 3, 3.5, 4, 5, 6, 8, 10, 12)
WINDOWS = (5, 7, 9, 13, 17, 23, 31)
#: How long (s) a foot takes from where it was locked back to its own path.
RELEASE_S = 0.2


def filters(fps: float, frames: int) -> Iterator[tuple[str, Callable[[np.ndarray], np.ndarray]]]:
    """Every filter that the oracle may choose."""
    for hz in (c for c in CUTOFFS if c < 0.49 * fps):
        sos = butter(4, hz, fs=fps, output="sos")
        yield (
            "butterworth",
            lambda x, sos=sos: sosfiltfilt(sos, x, axis=0, padlen=min(len(x) - 1, int(3 * fps))),
        )
    for window in (w for w in WINDOWS if w <= frames):
        yield "savitzky-golay", lambda x, w=window: np.asarray(savgol_filter(x, w, 3, axis=0))
    for hz in (0.5, 1.0, 2.0, 4.0, 8.0):
        for beta in (0.0, 0.5, 2.0):
            yield "one-euro", lambda x, hz=hz, beta=beta: one_euro(x, fps, hz, beta)


def one_euro(x: np.ndarray, fps: float, hz: float, beta: float) -> np.ndarray:
    """Casiez et al. 2012: a first-order low-pass whose cut-off grows with speed; it delays."""

    def share(cutoff: np.ndarray | float) -> np.ndarray | float:
        return 1.0 / (1.0 + fps / (2 * np.pi * cutoff))

    out, speed = x.copy(), np.zeros_like(x[0])
    for k in range(1, len(x)):
        speed += share(1.0) * ((x[k] - x[k - 1]) * fps - speed)
        a = share(hz + beta * np.abs(speed))
        out[k] = a * x[k] + (1 - a) * out[k - 1]
    return out


def filtered(clip: Clip, one: Callable[[np.ndarray], np.ndarray]) -> Clip:
    """The clip with the filter on the components of its quaternions and on its root."""
    rot = one(np.array(clip.rot).reshape(clip.frames, -1)).reshape(clip.rot.shape)
    rot = rot / np.maximum(np.linalg.norm(rot, axis=-1, keepdims=True), 1e-9)
    return clip.replaced(rot=rot, root_pos=one(np.array(clip.root_pos)))


def standing(places: np.ndarray, fps: float) -> np.ndarray:
    """`(T - 1, F)` bool, where feet at `places (T, F, 3)` m stand: within 5 cm of their lowest, slower
    than 0.1 m/s."""
    speed = np.linalg.norm(np.diff(places, axis=0), axis=-1) * fps
    return (places[1:, :, 2] < places[:, :, 2].min(0) + 0.05) & (speed < 0.1)


def foot_lock(clip: Clip, truth: Clip) -> Clip | None:
    """The clip with every foot locked where it touches down for as long as it stands in truth, its leg
    bent by inverse kinematics; then it goes back to its own path. None without known feet.

    What Kimodo's MotionCorrection does, from its description, and told the true contacts.
    """
    try:
        feet = [
            j for side in ("left", "right") for j in find_anatomy(clip.skeleton).of("foot", side)[:1]
        ]
    except PoiseError:
        return None
    leads, there = {}, clip.positions()
    for foot in feet:
        stands = standing(truth.positions()[:, [foot]], truth.fps)[:, 0]
        shift, frames = np.zeros((clip.frames, 3)), round(RELEASE_S * clip.fps)
        # A step between frames stands: the foot is locked from the frame before it on.
        for first, last in find_runs(stands, 0):
            touch = there[first, foot] + shift[first]
            shift[first : last + 2] = touch - there[first : last + 2, foot]
            fade = np.linspace(1.0, 0.0, frames + 2)[1:-1, None] * shift[last + 1]
            after = shift[last + 2 : last + 2 + frames]
            after[:] = fade[: len(after)]
        none = np.zeros(clip.frames)
        axis = np.tile([0.0, 1.0, 0.0], (clip.frames, 1))
        leads[foot] = Lead(shift, none, none, axis)
    root, rot = clip.arrays()
    return clip.replaced(rot=led(clip.skeleton, rot, root, leads))
