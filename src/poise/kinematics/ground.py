"""The floor's height under a motion, and the lift that sets the feet on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poise.body import BodyTable
from poise.kinematics.feet import stance_heights
from poise.kinematics.forward import Kinematics, low_and_com
from poise.kinematics.rate import Flight, find_flights
from poise.motion.smoothing import find_runs, smooth_hull, smooth_lift

#: Depth (m) that a shape may sink into the floor in the reference; contacts there push it out gently.
SINK_M = 0.02
#: Height (m) up to which a supported body may hover, since soles are rigid and heels lift; and the
#: height above which it stands on something or is in the air, and is no error of the capture.
HOVER_M, ALOFT_M = 0.03, 0.15


@dataclass(frozen=True)
class GroundFit:
    """How a motion was set on the floor.

    lift_m: constant lift of the whole clip. clear_m: `(T,)` further lift per frame that lets no shape
    sink deeper than `SINK_M` (smooth; zero where nothing did). settle_m: `(T,)` lowering where the body
    hovered for longer than 0.2 s without falling (smooth). flights: where it falls freely.
    before_m: height of the lowest point before. after_m: the same after, zero where nothing is under
    the floor.
    """

    lift_m: float
    clear_m: np.ndarray
    settle_m: np.ndarray
    flights: tuple[Flight, ...]
    before_m: float
    after_m: float

    def sentence(self) -> str:
        """The fit in words."""
        settled = ""
        if self.settle_m.max() > 0.0005:
            frames = int((self.settle_m > 0.0005).sum())
            settled = (
                f"It hovered without falling and was lowered by up to "
                f"{self.settle_m.max() * 1000:.0f} mm in {frames} frames. "
            )
        return settled + (
            f"Lifted by {round(self.lift_m * 1000):+d} mm to stand on the floor, and by up to "
            f"{self.clear_m.max() * 1000:.0f} mm more where a part sank in too deep "
            f"(deepest point {round(-self.before_m * 1000)} mm, now {abs(self.after_m) * 1000:.1f} mm)."
        )

    def to_dict(self) -> dict[str, float | int]:
        """The fit as numbers: metres and counts of frames."""
        return {
            "lift_m": self.lift_m,
            "clear_max_m": float(self.clear_m.max()),
            "clear_frames": int((self.clear_m > 0.0005).sum()),
            "settle_max_m": float(self.settle_m.max()),
            "settle_frames": int((self.settle_m > 0.0005).sum()),
            "flight_frames": sum(f.stop - f.start + 1 for f in self.flights),
            "lowest_before_m": self.before_m,
            "lowest_after_m": self.after_m,
        }


def fit_ground(
    qpos: np.ndarray,
    table: BodyTable,
    fps: float,
    cyclic: bool = False,
    sink_m: float = SINK_M,
    known: bool = False,
) -> tuple[np.ndarray, GroundFit]:
    """The motion set on the floor z = 0, and by how much it was moved.

    Flight is told from support by the fall of the centre of mass (`find_flights`). The constant lift
    sets the soles of standing feet (flat and slow, see `stance_heights`) on the floor, but never so low
    that the tenth percentile of the lowest points sinks by twice `SINK_M`; a clip in which no foot
    stands has that percentile set on the floor.
    A body that still hovers higher than `HOVER_M` for more than 0.2 s, neither in flight nor `ALOFT_M`
    high, is lowered there. Parts that sink in by more than `sink_m`, such as the toes of a rigid foot at
    push-off, are lifted out frame by frame (a replay without physics asks for less than the training:
    there contacts push such parts out). Both follow the running extreme of the excess over 0.1 s
    smoothed over 0.2 s; in a closed cycle also across the seam, so that it stays closed. A floor that is
    `known` to be at z = 0 needs no constant lift.
    """
    state = Kinematics(table)(qpos)
    fit = fit_heights(table, state.pos, state.quat, fps, cyclic, sink_m, known)
    out = np.array(qpos)
    out[:, 2] += fit.lift_m - fit.settle_m + fit.clear_m
    return out, fit


def fit_heights(
    table: BodyTable,
    pos: np.ndarray,
    quat: np.ndarray,
    fps: float,
    cyclic: bool = False,
    sink_m: float = SINK_M,
    known: bool = False,
    measured: tuple[np.ndarray, np.ndarray] | None = None,
) -> GroundFit:
    """How a motion with body poses `pos (T, B, 3)` m and `quat (T, B, 4)` would be set on the floor.

    See `fit_ground`, which does it. measured: `low_and_com` of the poses, where that is known.
    """
    low, com = low_and_com(table, pos, quat) if measured is None else measured
    flights = find_flights(low, com, fps)
    stance = stance_heights(table, pos, quat, fps)
    lift = -float(np.quantile(low, 0.1))
    if len(stance) >= 3:
        # Badly solved feet point their toes down while they stand; they may not drag the rest along.
        lift = max(-float(np.median(stance)), lift - 2 * SINK_M)
    lift = 0.0 if known else lift
    reach = max(1, round(0.1 * fps))
    # The mirror image of a clearance: a running minimum, so that no frame is lowered beyond its excess.
    settle = np.maximum(-smooth_hull(-_hover(low + lift, flights), reach, cyclic), 0.0)
    low_now = low + lift - settle
    depth = np.maximum(-low_now - sink_m, 0.0)
    clear = smooth_lift(depth, fps, 0.1, cyclic) * float(depth.max() > 1e-4)
    after = low_now + clear
    return GroundFit(lift, clear, settle, flights, float(low.min()), float(min(after.min(), 0.0)))


def _hover(height: np.ndarray, flights: tuple[Flight, ...]) -> np.ndarray:
    """How far `(T,)` m a supported body is above `HOVER_M`; through the air from its ends."""
    excess = np.maximum(height - HOVER_M, 0.0)
    air = np.zeros(len(height), dtype=bool)
    for first, last in find_runs(excess > 0.0, 0):
        if height[first : last + 1].max() > ALOFT_M:
            air[first : last + 1] = True
    for flight in flights:
        air[flight.start : flight.stop + 1] = True
    if air.all():
        return np.zeros_like(height)
    at = np.arange(len(height))
    return np.minimum(np.interp(at, at[~air], excess[~air]), excess)
