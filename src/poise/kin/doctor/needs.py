"""What a motion needs that is not there: a seat, something to hold or to stand on, a partner's arms."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from torch import Tensor

from poise.body import BodyTable
from poise.kin.balance import balance_point, hull_distance
from poise.kin.doctor.alone import AloneRules, NotAlone, beyond_a_floor
from poise.kin.solids import centre_of_mass, extreme_points, lowest_height

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
    table: BodyTable, pos: Tensor, quat: Tensor, fps: float, rules: AloneRules | None = None
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
    body = _Body(table, pos.double(), quat.double(), fps, rules)
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


class _Body:
    """Where the parts of a body are, and what a spell looks like."""

    def __init__(self, table: BodyTable, pos: Tensor, quat: Tensor, fps: float, rules: AloneRules):
        self.pos, self.quat, self.table, self.rules = pos, quat, table, rules
        self.p, self.fps = pos.numpy(), fps
        self.low = lowest_height(table, pos, quat).numpy()
        points = extreme_points(table, pos, quat).numpy()
        self.near = points[..., 2] < rules.near_m
        self.points = points[..., :2]
        com = centre_of_mass(table, pos, quat).numpy()
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
