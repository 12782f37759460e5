"""What a body's motion says of its frame rate: how it falls, how it balances, how it walks.

Played s times too fast, accelerations are s^2 times and speeds s times what they were; places stay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from poise.body import BodyTable
from poise.kin.balance import balance_point, beyond_reach, hull_reach
from poise.kin.feet.contact import NEAR_M, soles_of
from poise.kin.flight import Flight, find_flights
from poise.kin.series import find_runs
from poise.kin.solids import centre_of_mass, extreme_points, poses_of
from poise.motion import Clip
from poise.motion.io.guess import root_jumps
from poise.spatial import GRAVITY

#: Parts lower than this (m) above the floor may bear weight; a balance point beyond them by more than
#: that (m) has left them: a guessed body's soles are no better known.
BEAR_M, BEYOND_M = 0.05, 0.05
#: Standard deviations (s) of the low-passes on the centre of mass, for balance and for its fall.
BALANCE_S, FALL_S = 0.05, 0.03
#: Downward acceleration over gravity that nothing but a pull from below could give.
PULLED = 2.0
#: Standing feet that slip by more than this share of the way past them tell no travel: a motion in
#: place, or one that is not on its feet.
IN_PLACE = 0.4
#: Time (s) around a jump of the root's path that is no evidence.
JUMP_S = 0.15
#: A foot leads when it is ahead by this share of the leg's length.
LEADS = 0.12


@dataclass(frozen=True)
class Gait:
    """How a body steps. steps: how many. froude: v^2 / (g L), with the speed v (m/s) relative to the
    floor and the leg's length L (m). rate: steps per time sqrt(L / g). vault: minus the correlation of
    the height of the centre of mass with the distance of the feet: near 1 it vaults over a stiff leg, as
    in walking, near -1 it bounces, as in running. speed: v. steps_s: steps per second."""

    steps: int
    froude: float
    rate: float
    vault: float
    speed: float
    steps_s: float


class Moved:
    """One motion of a body, measured once, that is asked at several frame rates.

    low: `(T)` m, height of the lowest point. com: `(T, 3)` m. floor: m, its height under the motion.
    """

    def __init__(self, clip: Clip, table: BodyTable) -> None:
        self.fps, self.table = clip.fps, table
        self.pos, self.quat = poses_of(clip, table)
        points = extreme_points(table, self.pos, self.quat).numpy()
        self.com = centre_of_mass(table, self.pos, self.quat).numpy()
        self.low: np.ndarray = points[..., 2].min(-1)
        self.floor = float(np.quantile(self.low, 0.1))
        bears = points[..., 2] < self.floor + BEAR_M
        # A path that jumps, as from a rest pose, falls and tips without any speed.
        whole = np.ones(clip.frames, dtype=bool)
        reach = math.ceil(JUMP_S * clip.fps)
        for frame, _ in root_jumps(clip.root_pos, clip.fps):
            whole[max(0, frame - reach) : frame + reach] = False
        self._whole = whole
        self._touches = np.asarray(bears.any(-1)) & whole
        self._reach = hull_reach(points[..., :2], bears)

    @cached_property
    def flights(self) -> tuple[Flight, ...]:
        """See `find_flights`."""
        return find_flights(self.low, self.com, self.fps)

    def unbalanced(self, share: float) -> float:
        """Share of the frames on the floor in which the floor's force would have to act beyond all that
        touches it, at `share` of the clip's rate."""
        above = self.com - np.array([0.0, 0.0, self.floor])
        point, _ = balance_point(above, self.fps * share, BALANCE_S)
        out = beyond_reach(self._reach, point) > BEYOND_M
        return float((out & self._touches).sum() / max(1, self._touches.sum()))

    def pulled(self, share: float) -> tuple[float, int]:
        """Share of the frames, and the number of spells, in which the body falls with `PULLED` times
        gravity or more, at `share` of the clip's rate."""
        _, weight = balance_point(self.com, self.fps * share, FALL_S)
        bad = (weight < 1.0 - PULLED) & self._whole
        return float(bad.mean()), len(find_runs(bad, 1))

    @cached_property
    def slip(self) -> float | None:
        """How fast standing soles travel together, to one side of the body, over how fast it moves past
        them: near 0 where they stay or slide about, near 1 in a motion in place, in which soles travel
        for the body; None where none comes near the floor."""
        soles = soles_of(self.table, self.pos, self.quat)
        if not soles:
            return None
        ends = np.concatenate([s.ends.numpy() for s in soles.values()], 1)
        near = ends[..., 2] < self.floor + NEAR_M
        steps, own = np.diff(ends[..., :2], axis=0), np.diff(self.com[:, :2], axis=0)
        speed = np.where(near[1:] & near[:-1], np.linalg.norm(steps, axis=-1), np.inf)
        stands = speed.argmin(1)
        on = np.isfinite(speed.min(1))
        if not on.any():
            return None
        foot = steps[np.arange(len(steps)), stands][on]
        past = np.linalg.norm(own[on] - foot, axis=-1).mean()
        across = self._across
        if across is not None:
            # As the body sees it, which may turn: along its hips, and ahead.
            side = across[:-1][on]
            ahead = np.stack((side[:, 1], -side[:, 0]), -1)
            foot = np.stack(((foot * side).sum(-1), (foot * ahead).sum(-1)), -1)
        return float(np.linalg.norm(foot.mean(0)) / max(past, 1e-9))

    @property
    def travels(self) -> bool:
        """Whether standing feet vouch for the body's travel over the floor."""
        return self.slip is not None and self.slip <= IN_PLACE

    @cached_property
    def gait(self) -> Gait | None:
        """How it steps, at the clip's own rate; None where the body has no pair of legs or takes less
        than three steps."""
        legs = self._legs()
        if legs is None:
            return None
        ahead, length = legs
        at = _changes(ahead, LEADS * length)
        if len(at) < 4:
            return None
        first, last, steps = at[0], at[-1], len(at) - 1
        seconds = (last - first) / self.fps
        # From step to step, so that swaying is no travel.
        speed = float(np.linalg.norm(np.diff(self.com[at, :2], axis=0), axis=-1).sum()) / seconds
        span = slice(first, last + 1)
        window = max(3, 2 * round((last - first) / steps / 2) + 1)
        height, apart = (_detrended(x[span], window) for x in (self.com[:, 2], np.abs(ahead)))
        scale = float(np.linalg.norm(height) * np.linalg.norm(apart))
        vault = -float(height @ apart) / scale if scale > 0 else 0.0
        return Gait(
            steps, speed**2 / (GRAVITY * length), steps / seconds * math.sqrt(length / GRAVITY), vault,
            speed, steps / seconds,
        )  # fmt: skip

    @cached_property
    def _limbs(self) -> tuple[list[np.ndarray], ...] | None:
        """Places `(T, 3)` m of the hips, knees and ankles, left and right; None without a pair."""
        rows = {(r.kind, r.side): i for i, r in enumerate(self.table.rows)}
        try:
            return tuple(
                [self.pos[:, rows[kind, side]].numpy() for side in ("left", "right")]
                for kind in ("thigh", "shin", "foot")
            )
        except KeyError:
            return None

    @cached_property
    def _across(self) -> np.ndarray | None:
        """Unit vectors `(T, 2)` from the right hip to the left one."""
        if self._limbs is None:
            return None
        line = (self._limbs[0][0] - self._limbs[0][1])[:, :2]
        return line / np.maximum(np.linalg.norm(line, axis=-1, keepdims=True), 1e-9)

    def _legs(self) -> tuple[np.ndarray, float] | None:
        """How far `(T)` m the left ankle is ahead of the right one, and the legs' length (m)."""
        if self._limbs is None or self._across is None:
            return None
        hip, knee, ankle = self._limbs
        forwards = np.stack((self._across[:, 1], -self._across[:, 0]), -1)
        ahead = ((ankle[0] - ankle[1])[:, :2] * forwards).sum(-1)
        bones = [np.linalg.norm(a - b, axis=-1).mean() for a, b in zip(hip, knee, strict=True)]
        bones += [np.linalg.norm(a - b, axis=-1).mean() for a, b in zip(knee, ankle, strict=True)]
        # The sole lies below the ankle.
        sole = float(np.median(np.minimum(ankle[0][:, 2], ankle[1][:, 2]))) - self.floor
        return ahead, float(sum(bones)) / 2 + max(sole, 0.0)


def _changes(ahead: np.ndarray, least: float) -> Sequence[int]:
    """Frames at which another foot has come to lead by `least` m."""
    sign = np.where(ahead > least, 1, np.where(ahead < -least, -1, 0))
    at = np.flatnonzero(sign)
    turns = np.flatnonzero(np.diff(sign[at]) != 0)
    return [int(at[k + 1]) for k in turns]


def _detrended(values: np.ndarray, window: int) -> np.ndarray:
    """Values `(T)` without their mean over an odd `window`, which goes on at the ends as they are."""
    padded = np.pad(values, window // 2, mode="edge")
    out = values - np.convolve(padded, np.full(window, 1.0 / window), "valid")
    return out - out.mean()
