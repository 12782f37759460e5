"""Needs of a motion that are not met: a seat, something to hold or to stand on, a partner's arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from poise.body import BodyTable
from poise.kinematics.forward import centre_of_mass, extreme_points, lowest_height, poses_of
from poise.kinematics.ground import ALOFT_M
from poise.kinematics.rate import LEAST_WEIGHT, Flight, balance_point, find_flights, hull_distance
from poise.motion import Clip
from poise.motion.smoothing import find_runs

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
    table: BodyTable, pos: np.ndarray, quat: np.ndarray, fps: float, rules: AloneRules
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
    points = extreme_points(table, pos, quat)
    com = centre_of_mass(table, pos, quat)
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


#: Something that bears weight stays in its place: seats, steps and bars move slower than this (m/s).
STILL = 0.25
#: Up to this speed (m/s) of its centre of mass a body is at rest; where it runs or leaps the balance
#: point is told by accelerations, too rough to say what is missing.
REST = 0.5
#: A seated body has level thighs: knees lower than hips by at most this share of the thigh.
LEVEL = 0.7
#: A hand that holds something reaches out: this share of the arm's length from the shoulder.
REACH = 0.7
#: What holds in this share of a spell's frames holds in the spell.
MOSTLY = 0.6

SEAT, HOLD, STEP, CARRIED = "a seat", "something to hold", "something to stand on", "to be carried"
FLOOR, SUPPORT = "a lower floor", "a support"


@dataclass(frozen=True)
class Need:
    """What is missing from `start_s` to `stop_s` seconds of a motion.

    what: "a seat", "something to hold", "something to stand on", "to be carried", "a lower floor"; "a
    support" where the body is unsupported and its geometry does not say by what.
    """

    what: str
    start_s: float
    stop_s: float

    def clause(self) -> str:
        """The need as a clause: "it needs a seat from 2.1 to 5.0 s"."""
        when = f"from {self.start_s:.1f} to {self.stop_s:.1f} s"
        if self.what == SUPPORT:
            return f"its weight is unsupported {when}"
        return f"it needs {self.what} {when}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def find_needs(
    table: BodyTable, pos: np.ndarray, quat: np.ndarray, fps: float, rules: AloneRules | None = None
) -> tuple[Need, ...]:
    """What a motion needs besides a floor at z = 0, in order of time; spells of one need are joined.

    Spells in which a body cannot be alone are those of `beyond_a_floor`. A seat: pelvis and thighs are
    off the floor and still, the thighs level, the trunk upright and the pelvis itself outside of the
    support. Something to hold: a hand that reaches out stays in its place above the head or in the way
    in which the weight lies outside. Something to stand on: the body's lowest part is a foot, which is
    still. To be carried: it is above the floor, in motion, and does not fall.

    Args:
        table: the body. pos, quat: `(T, B, 3)` m and `(T, B, 4)` wxyz, places of its rows in the world.
    """
    rules = rules or AloneRules()
    body = _BodyShape(table, pos.astype(float), quat.astype(float), fps, rules)
    found: list[Need] = []
    for spell in beyond_a_floor(table, body.pos, body.quat, fps, rules):
        what = body.need(spell)
        if not what:
            continue
        need = Need(what, spell.start / fps, spell.stop / fps)
        same = found and found[-1].what == need.what and need.start_s - found[-1].stop_s < rules.lean_s
        if same:
            found[-1] = Need(need.what, found[-1].start_s, need.stop_s)
        else:
            found.append(need)
    return tuple(found)


class _BodyShape:
    """Where the parts of a body are, and what a spell looks like."""

    def __init__(
        self, table: BodyTable, pos: np.ndarray, quat: np.ndarray, fps: float, rules: AloneRules
    ):
        self.pos, self.quat, self.table, self.rules = pos, quat, table, rules
        self.p, self.fps = pos, fps
        self.low = lowest_height(table, pos, quat)
        points = extreme_points(table, pos, quat)
        self.near = points[..., 2] < rules.near_m
        self.points = points[..., :2]
        com = centre_of_mass(table, pos, quat)
        self.balance = balance_point(com, fps)[0]
        self.speed = np.linalg.norm(np.gradient(com[:, :2], axis=0), axis=-1) * fps

    def rows(self, *kinds: str) -> list[int]:
        return [i for i, row in enumerate(self.table.rows) if row.kind in kinds]

    def need(self, spell: NotAlone) -> str:
        """The first of all needs that the spell looks like; "" where it is too fast to tell."""
        at = slice(spell.start, spell.stop + 1)
        if spell.kind == "below":
            return FLOOR
        if self._sits(at):
            return SEAT
        if self._holds(at, spell.kind == "leaning"):
            return HOLD
        if spell.kind == "leaning":
            return SUPPORT if np.median(self.speed[at]) <= REST else ""
        feet, lowest = self.rows("foot"), self.low[at].argmin(-1)
        on_feet = np.isin(lowest, feet) & self._still(at, lowest)
        return STEP if on_feet.mean() >= MOSTLY else CARRIED

    def _sits(self, at: slice) -> bool:
        thighs, shins, head = self.rows("thigh"), self.rows("shin"), self.rows("head", "neck")
        if len(thighs) != 2 or len(shins) != 2 or not head:
            return False
        hips, knees, pelvis = self.p[at][:, thighs], self.p[at][:, shins], self.p[at][:, 0]
        thigh = np.linalg.norm(hips - knees, axis=-1)
        level = (hips - knees)[..., 2].max(-1) <= LEVEL * thigh.mean(-1)
        trunk = self.p[at][:, head[0]] - pelvis
        upright = trunk[:, 2] >= 0.5 * np.linalg.norm(trunk, axis=-1)
        clear = self.low[at][:, [0, *thighs]].min(-1) > self.rules.near_m
        still = self._still(at, np.zeros(len(pelvis), dtype=int))
        outside = hull_distance(self.points[at], self.near[at], pelvis[:, :2]) > 0.0
        return bool((level & upright & clear & still & outside).mean() >= MOSTLY)

    def _holds(self, at: slice, leaning: bool) -> bool:
        hands, uppers = self.rows("hand"), self.rows("upper_arm")
        fores, head = self.rows("forearm"), self.rows("head", "neck")
        if not len(hands) == len(uppers) == len(fores) == 2 or not head:
            return False
        p = self.p[at]
        near = self.near[at][..., None]
        middle = (self.points[at] * near).sum(1) / np.maximum(near.sum(1), 1)
        away = self.balance[at] - middle
        away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
        trunk = p[:, head[0]] - p[:, 0]
        trunk /= np.maximum(np.linalg.norm(trunk, axis=-1, keepdims=True), 1e-9)
        for hand, upper, fore in zip(hands, uppers, fores, strict=True):
            arm = p[:, hand] - p[:, upper]
            length = np.linalg.norm(p[:, fore] - p[:, upper], axis=-1)
            length += np.linalg.norm(p[:, hand] - p[:, fore], axis=-1)
            # Away from the shoulder, and not beside the trunk.
            out = np.linalg.norm(arm, axis=-1) >= REACH * length
            out &= (arm * trunk).sum(-1) >= -REACH * length
            high = p[:, hand, 2] > p[:, head[0], 2]
            # Against a wall in the way of the weight, or from a rail or a hand on the other side.
            along = np.abs((arm[:, :2] * away).sum(-1)) >= 0.5 * length
            good = out & (high | along if leaning else high)
            if (good & self._still(at, np.full(len(p), hand))).mean() >= MOSTLY:
                return True
        return False

    def _still(self, at: slice, row: np.ndarray) -> np.ndarray:
        """`(t)` whether the part `row (t)` is still in the frames `at`."""
        step = np.linalg.norm(np.gradient(self.p, axis=0), axis=-1) * self.fps
        return step[at][np.arange(len(row)), row] < STILL
