"""What no humanoid can do alone on a floor: be held, sit on furniture, lean on a partner, swim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from torch import Tensor

from poise.body import BodyTable
from poise.kin.balance import LEAST_WEIGHT, balance_point, hull_distance
from poise.kin.flight import Flight, find_flights
from poise.kin.ground import ALOFT_M
from poise.kin.series import find_runs
from poise.kin.solids import centre_of_mass, extreme_points, poses_of
from poise.motion import Clip

Kind = Literal["held", "leaning", "below", "leap"]
#: Gap (s) that belongs to one spell under the floor, of leaning, and what is cut off around any spell.
GAP_S, TOUCH_S, EDGE_S = 0.2, 0.1, 0.1


@dataclass(frozen=True)
class AloneRules:
    """Where a motion needs more than a floor.

    near_m: parts lower than this may bear weight. margin_m: how far (m) the balance point may lie
        beyond them; half a foot, which covers a guessed body's error. lean_s: for how long. With the
        pendulum's rate w = sqrt(g / z) = 3.2 /s, a body off by 0.15 m gets 0.15 (cosh(w t) - 1) = 0.4 m
        farther in 0.6 s, so beyond that it falls.
    aloft_m: height of the lowest part above which the body is off the floor. held_s: how long it may
        be there without falling: g t^2 / 8 = 0.44 m is how far a body that does fall is away by then.
    jump_s: the longest flight of a jump; 1.0 s is one of 1.2 m, the best there are. fastest: m/s, beyond
        which a root leaps; sprinters reach 12.4.
    """

    near_m: float = 0.15
    margin_m: float = 0.15
    lean_s: float = 0.6
    aloft_m: float = ALOFT_M
    held_s: float = 0.6
    jump_s: float = 1.0
    fastest: float = 13.0


@dataclass(frozen=True)
class NotAlone:
    """Frames `start` to `stop` (inclusive) of a clip that need more than a floor.

    kind: "held" above the floor without falling, "leaning" outside of its support, "below" the floor, or
    a "leap" of the root (`leaps`). size_m: how high, how far, or how deep at most. seconds: how long.
    lead, trail: frames before and after it in which no floor bears the body either, too short to count
    by themselves.
    """

    kind: Kind
    start: int
    stop: int
    size_m: float
    seconds: float
    lead: int = 0
    trail: int = 0

    def sentence(self, fps: float) -> str:
        """The spell in words, without a full stop."""
        when = f"for {self.seconds:.1f} s from {self.start / fps:.1f} s on"
        if self.kind == "held":
            return f"{when} it is up to {self.size_m:.2f} m above the floor and does not fall"
        if self.kind == "leap":
            return f"its root leaps by {self.size_m:.2f} m in a frame at {self.stop / fps:.2f} s"
        if self.kind == "below":
            return f"{when} it is up to {self.size_m:.2f} m under its floor, so it has several floors"
        return (
            f"{when} its weight lies up to {self.size_m:.2f} m beyond all that touches the floor, so it "
            "sits, leans or is held"
        )


def not_alone(clip: Clip, table: BodyTable, rules: AloneRules | None = None) -> tuple[NotAlone, ...]:
    """Spells of a clip, standing on z = 0, that its body `table` cannot do alone (`beyond_a_floor`)."""
    return beyond_a_floor(table, *poses_of(clip, table), clip.fps, rules or AloneRules())


def leaps(clip: Clip, rules: AloneRules | None = None) -> tuple[NotAlone, ...]:
    """Frames of a clip to which its root steps faster than anybody runs: breaks of the recording."""
    steps = np.linalg.norm(np.diff(clip.root_pos, axis=0), axis=-1)
    found = np.flatnonzero(steps * clip.fps > (rules or AloneRules()).fastest)
    return tuple(NotAlone("leap", int(t), int(t) + 1, float(steps[t]), 1 / clip.fps) for t in found)


def beyond_a_floor(
    table: BodyTable, pos: Tensor, quat: Tensor, fps: float, rules: AloneRules
) -> tuple[NotAlone, ...]:
    """Spells of a motion, standing on z = 0, that need more than a floor; in order of time.

    Held: the lowest point is above `aloft_m` for more than `held_s` and the centre of mass c does not
    follow a parabola (`find_flights`), or it does for more than `jump_s`. Leaning: the point about
    which the floor's force has no horizontal moment (Vukobratovic's zero moment point, without the
    body's own spin), p = c_xy - c_z c''_xy / (g + c''_z), is farther than `margin_m` from the convex
    hull of the parts below `near_m`, for more than `lean_s`. Below: the lowest point is deeper than
    `aloft_m` for more than `held_s`.

    Args:
        pos, quat: `(T, B, 3)` m and `(T, B, 4)` wxyz, places of the body's rows in the world.
    """
    points = extreme_points(table, pos, quat).numpy()
    com = centre_of_mass(table, pos, quat).numpy()
    low = points[..., 2].min(-1)
    flights = find_flights(low, com, fps)
    found = _held(low, flights, fps, rules)
    out = np.where(low > rules.near_m, 0.0, _beyond(points, com, fps, rules.near_m))
    found += _spells("leaning", out, out > rules.margin_m, rules.lean_s, fps, TOUCH_S)
    found += _spells("below", -low, -low > rules.aloft_m, rules.held_s, fps, GAP_S)
    unborne = (np.abs(low) > rules.near_m) | (out > rules.margin_m)
    return tuple(sorted((_with_ends(f, unborne, fps) for f in found), key=lambda f: f.start))


def _with_ends(found: NotAlone, unborne: np.ndarray, fps: float) -> NotAlone:
    """The spell with how long the body is not borne before and after it, moments aside."""
    for a, b in find_runs(unborne, round(GAP_S * fps)):
        if a <= found.stop and b >= found.start:
            return replace(found, lead=max(0, found.start - a), trail=max(0, b - found.stop))
    return found


def longest_alone(clip: Clip, found: Sequence[NotAlone]) -> tuple[int, int]:
    """The longest stretch `[first, stop)` of frames without any of the spells and what leads there and
    away, (0, 0) without any."""
    bad = np.zeros(clip.frames, dtype=bool)
    edge = round(EDGE_S * clip.fps)
    for f in found:
        bad[max(f.start - f.lead - edge, 0) : f.stop + f.trail + 1 + edge] = True
    free = [(a, b + 1) for a, b in find_runs(~bad, 0)]
    return max(free, key=lambda s: s[1] - s[0], default=(0, 0))


def _beyond(points: np.ndarray, com: np.ndarray, fps: float, near: float) -> np.ndarray:
    """`(T)` m, how far the balance point lies outside of the support; 0 where the body nearly falls."""
    balance, weight = balance_point(com, fps)
    near_floor = points[..., 2] < near
    out = hull_distance(points[..., :2], near_floor, balance)
    return np.where((weight > LEAST_WEIGHT) & near_floor.any(-1), out, 0.0)


def _held(low: np.ndarray, flights: Sequence[Flight], fps: float, rules: AloneRules) -> list[NotAlone]:
    falling = np.zeros(len(low), dtype=bool)
    for f in flights:
        if (f.stop - f.start + 1) / fps <= rules.jump_s:
            falling[f.start : f.stop + 1] = True
    return _spells("held", low, (low > rules.aloft_m) & ~falling, rules.held_s, fps)


def _spells(
    kind: Kind, size: np.ndarray, where: np.ndarray, longest_s: float, fps: float, gap_s: float = 0.0
) -> list[NotAlone]:
    return [
        NotAlone(kind, a, b, float(size[a : b + 1].max()), (b - a + 1) / fps)
        for a, b in find_runs(where, round(gap_s * fps))
        if (b - a + 1) / fps > longest_s
    ]
