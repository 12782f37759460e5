"""Flight told from support by gravity, and the frame rate that gravity vouches for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.kin.series import find_runs
from poise.spatial import GRAVITY

#: A body may be in flight where its lowest point is this far (m) above where it mostly touches down, for
#: this long (s). Shorter and lower hops say nothing, since a foot's own roll lifts its sole as much.
AIR_M, AIR_S = 0.06, 0.1
#: It falls where its centre of mass follows a parabola this closely (m, rms) at half of gravity or more.
PARABOLA_M = 0.02
#: A flight may judge the frame rate if it rises this far (m) above its ends, follows its parabola within
#: this share of its rise (rms), has its top in the middle half, and is drawn aside by at most this share
#: of its fall: gravity pulls straight down.
RISE_M, ARC, ASIDE = 0.03, 0.05, 0.3
#: Slow motion is told only by arcs that rise farther (m) and are clearer: a smooth lift (a raised
#: cosine) is no parabola within such a share. Down to this share of gravity: 120 frames/s played at 24.
SLOW_RISE_M, SLOW_ARC, SLOWEST = 0.05, 0.02, 0.03
#: Share of a flight that is left out at either end, where feet still push or land already; and the least
#: frames that are left.
TRIM, LEAST = 0.08, 5
#: The share of gravity beyond which, or its inverse below which, a fall contradicts the frame rate.
DOUBT = 2.0


@dataclass(frozen=True)
class Flight:
    """Frames `start` to `stop` (inclusive) in which nothing supports the body.

    fall: downward acceleration of the centre of mass, m/s^2. rms_m: its distance from that parabola.
    aside: its horizontal acceleration over its fall. rise_m: how far the parabola rises above its ends.
    top: the share of the flight after which it is highest.
    """

    start: int
    stop: int
    fall: float
    rms_m: float
    aside: float = 0.0
    rise_m: float = 0.0
    top: float = 0.5

    @property
    def clear(self) -> bool:
        """Whether the flight may judge the frame rate, see `RISE_M` and `SLOW_RISE_M`."""
        frames = self.stop - self.start + 1
        slow = self.fall < GRAVITY / DOUBT
        rise, arc = (SLOW_RISE_M, SLOW_ARC) if slow else (RISE_M, ARC)
        return (
            _trimmed(frames) > 0
            and self.fall >= SLOWEST * GRAVITY
            and self.rise_m >= rise
            and self.rms_m <= arc * self.rise_m
            and 0.25 <= self.top <= 0.75
            and self.aside <= ASIDE
        )


def _trimmed(frames: int) -> int:
    """Frames that are left out at either end of a flight; none of one that is too short for it."""
    count = math.ceil(TRIM * frames)
    return count if frames - 2 * count >= LEAST else 0


def _fitted(start: int, stop: int, com: np.ndarray, fps: float, cut: int) -> Flight:
    """The parabola of a spell in the air, `cut` frames left out at either end."""
    here = com[start + cut : stop + 1 - cut]
    t = np.arange(len(here)) / fps
    basis = np.stack((np.ones(len(here)), t, -t * t / 2), 1)
    fit = np.linalg.lstsq(basis, here, rcond=None)[0]
    rms = float(np.sqrt(np.mean((basis @ fit - here)[:, 2] ** 2)))
    fall, seconds = float(fit[2, 2]), float(t[-1])
    aside = float(np.linalg.norm(fit[2, :2])) / max(fall, 1e-9)
    # The top, where b = c t.
    top = float(fit[1, 2]) / max(fall, 1e-9) / seconds
    return Flight(start, stop, fall, rms, aside, fall * seconds**2 / 8, top)


def find_flights(low: np.ndarray, com: np.ndarray, fps: float) -> tuple[Flight, ...]:
    """Flights of a body with lowest points `low (T)` and centre of mass `com (T, 3)`, both m.

    A spell in the air counts as flight where z(t) = a + b t - c t^2 / 2 fits the centre of mass, its
    ends left out, within `PARABOLA_M` with c of at least half of gravity; or where the parabola is clear
    beyond doubt whatever it falls with. Spells cut off by the clip's ends count too.
    """
    found = []
    for start, stop in find_runs(low - np.quantile(low, 0.1) > AIR_M, 0):
        frames = stop - start + 1
        if frames < max(4, round(AIR_S * fps)):
            continue
        flight = _fitted(start, stop, com, fps, 0)
        if flight.fall >= GRAVITY / DOUBT:
            # A slow lift has smooth ends, which tell it from a fall.
            flight = _fitted(start, stop, com, fps, _trimmed(frames))
        if flight.clear or (flight.rms_m <= PARABOLA_M and flight.fall >= GRAVITY / 2):
            found.append(flight)
    return tuple(found)


def clear_fall(flights: Sequence[Flight]) -> float | None:
    """The median fall (m/s^2), weighted by the rise, of the flights that are clear; None without any."""
    clear = sorted((f for f in flights if f.clear), key=lambda f: f.fall)
    if not clear:
        return None
    share = np.cumsum([f.rise_m for f in clear])
    return clear[int(np.searchsorted(share, share[-1] / 2))].fall
