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
#: The same for a flight that may judge the frame rate.
CLEAR_PARABOLA_M = 0.005
#: Rates that files have, Hz, and the share of gravity beyond which the rate is doubted.
RATES, DOUBT = (24.0, 25.0, 30.0, 50.0, 60.0, 90.0, 100.0, 120.0, 240.0), 2.0


@dataclass(frozen=True)
class Flight:
    """Frames `start` to `stop` (inclusive) in which nothing supports the body.

    fall: downward acceleration of the centre of mass, m/s^2. rms_m: its distance from that parabola.
    """

    start: int
    stop: int
    fall: float
    rms_m: float


def find_flights(low: np.ndarray, height: np.ndarray, fps: float) -> tuple[Flight, ...]:
    """Flights of a body with lowest points `low (T)` and centre of mass at `height (T)`, both m.

    A spell in the air counts as flight where z(t) = a + b t - c t^2 / 2 fits the centre of mass within
    `PARABOLA_M` with c of at least half of gravity. Spells cut off by the clip's ends count too.
    """
    found = []
    for start, stop in find_runs(low - np.quantile(low, 0.1) > AIR_M, 0):
        frames = stop - start + 1
        if frames < max(4, round(AIR_S * fps)):
            continue
        t = np.arange(frames) / fps
        basis = np.stack((np.ones(frames), t, -t * t / 2), 1)
        here = height[start : stop + 1]
        fit = np.linalg.lstsq(basis, here, rcond=None)[0]
        rms = float(np.sqrt(np.mean((basis @ fit - here) ** 2)))
        if fit[2] >= GRAVITY / 2 and rms <= PARABOLA_M:
            found.append(Flight(start, stop, float(fit[2]), rms))
    return tuple(found)


def clear_fall(flights: Sequence[Flight]) -> float | None:
    """The median fall (m/s^2) of the flights that follow a clear parabola, None without any."""
    falls = [f.fall for f in flights if f.rms_m <= CLEAR_PARABOLA_M]
    return float(np.median(falls)) if falls else None


def likely_rate(flights: Sequence[Flight], fps: float) -> float | None:
    """The frame rate (Hz) at which bodies would fall with g, where the stated one is far off.

    Played s times too fast, a body falls with s^2 g. Only clear parabolas judge.
    """
    fall = clear_fall(flights)
    if fall is None or fall < DOUBT * GRAVITY:
        return None
    rate = fps / math.sqrt(fall / GRAVITY)
    return min(RATES, key=lambda r: abs(math.log(r / rate)))


def rate_sentence(flights: Sequence[Flight], fps: float) -> str | None:
    """The doubt about the frame rate in words, or None."""
    rate = likely_rate(flights, fps)
    if rate is None:
        return None
    fall = clear_fall(flights) or GRAVITY
    return (
        f"In flight the body falls with {fall:.0f} m/s^2, {fall / GRAVITY:.1f} times gravity: the clip "
        f"likely has {rate:g} frames per second, not {fps:.4g}; state it with --fps {rate:g}."
    )
