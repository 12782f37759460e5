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
#: The same for a flight that may judge the frame rate; gravity pulls straight down, so that the sideways
#: acceleration is at most this share of the fall.
CLEAR_PARABOLA_M, ASIDE = 0.005, 0.25
#: Slow motion is told only by arcs that rise this far (m) above their ends, have their top in the middle
#: half, and are parabolas within this share of their rise: a smooth lift (a raised cosine) is farther
#: from one. Down to this share of gravity: a motion of 120 frames/s played at 24.
RISE_M, ARC, SLOWEST = 0.05, 0.02, 0.03
#: Rates that files have, Hz, and the share of gravity beyond which, or its inverse below which, the rate
#: is doubted.
RATES, DOUBT = (24.0, 25.0, 30.0, 50.0, 60.0, 90.0, 100.0, 120.0, 240.0), 2.0


@dataclass(frozen=True)
class Flight:
    """Frames `start` to `stop` (inclusive) in which nothing supports the body.

    fall: downward acceleration of the centre of mass, m/s^2. rms_m: its distance from that parabola.
    aside: its horizontal acceleration over its fall.
    """

    start: int
    stop: int
    fall: float
    rms_m: float
    aside: float = 0.0


def find_flights(low: np.ndarray, com: np.ndarray, fps: float) -> tuple[Flight, ...]:
    """Flights of a body with lowest points `low (T)` and centre of mass `com (T, 3)`, both m.

    A spell in the air counts as flight where z(t) = a + b t - c t^2 / 2 fits the centre of mass within
    `PARABOLA_M` with c of at least half of gravity; with less, in slow motion, only where the arc is
    clear beyond doubt (`RISE_M`). Spells cut off by the clip's ends count too.
    """
    found = []
    for start, stop in find_runs(low - np.quantile(low, 0.1) > AIR_M, 0):
        frames = stop - start + 1
        if frames < max(4, round(AIR_S * fps)):
            continue
        t = np.arange(frames) / fps
        basis = np.stack((np.ones(frames), t, -t * t / 2), 1)
        here = com[start : stop + 1]
        fit = np.linalg.lstsq(basis, here, rcond=None)[0]
        rms = float(np.sqrt(np.mean((basis @ fit - here)[:, 2] ** 2)))
        fall, rise = float(fit[2, 2]), float(fit[2, 2]) * t[-1] ** 2 / 8
        aside = float(np.linalg.norm(fit[2, :2])) / max(fall, 1e-9)
        slow = fall >= SLOWEST * GRAVITY and rise >= RISE_M and rms <= ARC * rise and aside <= ASIDE
        # The top, where b = c t.
        slow = slow and 0.25 * t[-1] <= fit[1, 2] / fall <= 0.75 * t[-1]
        if rms <= PARABOLA_M and (fall >= GRAVITY / 2 or slow):
            found.append(Flight(start, stop, fall, rms, aside))
    return tuple(found)


def clear_fall(flights: Sequence[Flight]) -> float | None:
    """The median fall (m/s^2) of the flights that follow a clear parabola, None without any."""
    falls = [f.fall for f in flights if f.rms_m <= CLEAR_PARABOLA_M and f.aside <= ASIDE]
    return float(np.median(falls)) if falls else None


def usual_rate(fps: float) -> float:
    """The rate (Hz) that files have nearest to `fps`."""
    return min(RATES, key=lambda r: abs(math.log(r / fps)))


def likely_rate(flights: Sequence[Flight], fps: float) -> float | None:
    """The frame rate (Hz) at which bodies would fall with g, where the stated one is far off.

    Played s times too fast, a body falls with s^2 g; s is below 1 in slow motion. Only clear parabolas
    judge.
    """
    fall = clear_fall(flights)
    if fall is None or GRAVITY / DOUBT < fall < DOUBT * GRAVITY:
        return None
    return usual_rate(fps / math.sqrt(fall / GRAVITY))


def rate_sentence(flights: Sequence[Flight], fps: float) -> str | None:
    """The doubt about the frame rate in words, or None."""
    rate = likely_rate(flights, fps)
    if rate is None:
        return None
    fall = clear_fall(flights) or GRAVITY
    way = "too slow" if fall < GRAVITY else "too fast"
    return (
        f"In flight the body falls with {fall:.1f} m/s^2, {fall / GRAVITY:.3g} times gravity, {way}: "
        f"the clip likely has {rate:g} frames per second, not {fps:.4g}; state it with --fps {rate:g}."
    )
