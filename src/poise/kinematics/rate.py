"""The frame rate that a motion has by physics: how it falls, balances, walks; and the judgement."""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from poise.body import BodyTable, body_of
from poise.errors import PoiseError
from poise.formats import read_clip as read_as_stated
from poise.formats.guess import root_jumps
from poise.kinematics.feet import NEAR_M, soles_of
from poise.kinematics.forward import centre_of_mass, extreme_points, poses_of
from poise.metrics.shape_points import PIECE
from poise.motion import Clip
from poise.motion.clip import remembered
from poise.motion.rotations import GRAVITY
from poise.motion.smoothing import find_runs, gaussian

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


#: Standard deviation (s) of the low-pass on the centre of mass before it is differentiated twice.
SMOOTH_S = 0.1
#: Least upward force over weight at which a balance point says anything; below, the body nearly falls.
LEAST_WEIGHT = 0.5
#: Directions in which the support is measured; between two of them it is 0.5 % off.
DIRECTIONS = 32
_ANGLES = 2 * math.pi * np.arange(DIRECTIONS) / DIRECTIONS
_WAYS = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)))


def balance_point(
    com: np.ndarray, fps: float, smooth_s: float = SMOOTH_S
) -> tuple[np.ndarray, np.ndarray]:
    """Zero moment point `(T, 2)` m on z = 0 of a centre of mass `(T, 3)` m, and force over weight `(T)`.

    p = c_xy - c_z c''_xy / (g + c''_z) is the point about which the floor's force has no horizontal
    moment (Vukobratovic), without the body's own spin. The path is smoothed by a Gaussian of `smooth_s`,
    going on beyond its ends as it comes.
    """
    reach = min(round(4 * smooth_s * fps), len(com) - 1)
    kernel = gaussian(smooth_s * fps, reach)
    # An odd reflection keeps the speed at the ends, where an even one would stop the body.
    padded = np.pad(com, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    smooth = np.stack([np.convolve(x, kernel, "valid") for x in padded.T], -1)
    acc = np.gradient(np.gradient(smooth, axis=0), axis=0) * fps**2
    up = GRAVITY + acc[:, 2]
    held = np.maximum(up, LEAST_WEIGHT * GRAVITY)
    return smooth[:, :2] - (smooth[:, 2] / held)[:, None] * acc[:, :2], up / GRAVITY


def hull_distance(points: np.ndarray, mask: np.ndarray, at: np.ndarray) -> np.ndarray:
    """`(T)` m, how far `at (T, 2)` lies outside the hull of `points (T, P, 2)` under `mask (T, P)`.

    Inside it is negative; without any point it is infinite.
    """
    return beyond_reach(hull_reach(points, mask), at)


def hull_reach(points: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """`(T, DIRECTIONS)` m, max_p d . p over `points (T, P, 2)` under `mask (T, P)` for each unit
    direction d; minus infinity without any point."""
    # All frames of an hour at once would take gigabytes.
    parts = [slice(k, k + PIECE) for k in range(0, len(points), PIECE)]
    return np.concatenate([np.where(mask[p, :, None], points[p] @ _WAYS, -np.inf).max(1) for p in parts])


def beyond_reach(reach: np.ndarray, at: np.ndarray) -> np.ndarray:
    """`(T)` m, how far `at (T, 2)` lies outside a convex set of a `reach (T, DIRECTIONS)`, see
    `hull_reach`: max_d (d . at - reach_d)."""
    return (at @ _WAYS - reach).max(-1)


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

    Played s times too fast, accelerations are s^2 times and speeds s times what they were; places stay.

    low: `(T)` m, height of the lowest point. com: `(T, 3)` m. floor: m, its height under the motion.
    """

    def __init__(self, clip: Clip, table: BodyTable) -> None:
        self.fps, self.table = clip.fps, table
        self.pos, self.quat = poses_of(clip, table)
        points = extreme_points(table, self.pos, self.quat)
        self.com = centre_of_mass(table, self.pos, self.quat)
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
        ends = np.concatenate([s.ends for s in soles.values()], 1)
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
                [self.pos[:, rows[kind, side]] for side in ("left", "right")]
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


Kind = Literal["fall", "balance", "gait"]
#: Rates that files have, Hz.
RATES = (24.0, 25.0, 30.0, 50.0, 60.0, 90.0, 100.0, 120.0, 240.0)
#: Where no flight tells the rate itself, the stated one is compared with this share of it, and that with
#: as much of itself again.
SHARE = 0.5
#: Evidence is clear with this weight: one clear kind, or two that hint.
CLEAR, HINT = 1.0, 0.5
#: A body is pulled down in at least this share of the frames; it is out of balance in this share of
#: them, clearly or as a hint. A lower rate, if that is the reason, leaves a third; noise leaves it all.
PULLED_SHARE, UNBALANCED, UNBALANCED_HINT, LEFT = 0.02, 0.5, 0.3, 1 / 3
#: It walks where it vaults by this correlation. In walking people take up to 0.75 steps per
#: sqrt(L / g), twice as many as a leg would swing by itself, and above a Froude number of 0.5 they run:
#: both with room.
VAULTS, STEP_RATE, FROUDE = 0.3, 0.85, 0.6
#: Fewer frames are no evidence. Of a clip of more than so many every second or so is judged, down to
#: this rate (Hz), and of what is left the middle: half a minute tells enough.
LEAST_FRAMES, MANY_FRAMES, MOST_FRAMES, ENOUGH_HZ = 16, 1200, 1800, 60.0
#: Share by which a rate may differ from one that files have; and factor within which a fall tells it: a
#: guessed body's centre of mass, and its size, are no better known.
USUAL, TOLD = 0.02, 1.25


@dataclass(frozen=True)
class Reason:
    """One kind of evidence: its weight (`CLEAR` or `HINT`) and what it is, in words without a stop."""

    kind: Kind
    weight: float
    says: str


@dataclass(frozen=True)
class RateJudgement:
    """What physics says of a frame rate.

    fps: the rate judged, frames/s. likely: the rate that the motion has where the evidence against `fps`
    is clear, else None. reasons: the evidence for it. fall: m/s^2, of bodies in clear flight at `fps`,
    None where there is none.
    """

    fps: float
    likely: float | None = None
    reasons: tuple[Reason, ...] = ()
    fall: float | None = None

    @property
    def vouched(self) -> bool:
        """Whether bodies in flight fall with gravity."""
        return self.fall is not None and self.likely is None

    def why(self) -> str:
        """The reasons in words, without a full stop; empty without any."""
        return ", and ".join(r.says for r in self.reasons)

    def sentence(self) -> str | None:
        """The doubt about the rate, or None."""
        if self.likely is None:
            return None
        why = self.why()
        return (
            f"{why[0].upper()}{why[1:]}: the clip likely has {self.likely:g} frames per second, not "
            f"{self.fps:.4g}; state it with --fps {self.likely:g}."
        )


def usual_rate(fps: float) -> float:
    """The rate (Hz) that files have nearest to `fps`."""
    return min(RATES, key=lambda r: abs(math.log(r / fps)))


def judge_rate(clip: Clip, table: BodyTable | None = None) -> RateJudgement:
    """What a clip's motion says of its frame rate.

    Flights tell the rate itself. Without a clear one the stated rate is compared with half and a quarter
    of it: no floor pulls a body down, its force acts where something touches it, and people do not walk
    as fast as they run. Balance and walking say nothing of motion in place, and none of it that a
    motion is too slow. A motion of no human, or a short one, is not judged.

    table: a body on the clip's skeleton; by default one is made.
    """
    if clip.frames < LEAST_FRAMES:
        return RateJudgement(clip.fps)
    return _judged(clip) if table is None else judge_moved(Moved(_part(clip), table), clip.fps)


@remembered
def _judged(clip: Clip) -> RateJudgement:
    try:
        return judge_rate(clip, body_of(clip))
    except PoiseError:
        return RateJudgement(clip.fps)


def judge_moved(moved: Moved, fps: float) -> RateJudgement:
    """The same of a motion that is measured; `fps` is the rate that it is stated to have."""
    fall = clear_fall(moved.flights)
    if fall is not None:
        if GRAVITY / DOUBT < fall < DOUBT * GRAVITY:
            return RateJudgement(fps, None, (), fall)
        says = f"in flight the body falls with {fall:.1f} m/s^2, {fall / GRAVITY:.3g} times gravity"
        says += ", too slow" if fall < GRAVITY else ", too fast"
        rate = _file_rate(fps / math.sqrt(fall / GRAVITY), fps)
        return RateJudgement(fps, rate, (Reason("fall", CLEAR, says),), fall)
    half, quarter = SHARE, SHARE**2
    if reasons := _against(moved, fps, 1.0, half):
        return RateJudgement(fps, _file_rate(fps * half, fps), reasons)
    if (reasons := _against(moved, fps, 1.0, quarter)) and _against(moved, fps, half, quarter):
        return RateJudgement(fps, _file_rate(fps * quarter, fps), reasons)
    return RateJudgement(fps)


def _against(moved: Moved, fps: float, at: float, share: float) -> tuple[Reason, ...]:
    """The evidence that a motion has `share` of its stated rate, and not the share `at`; empty where
    it is not clear."""
    found = (
        _pulled(moved, at, share),
        # Balance and gait need the travel that standing feet tell.
        *((_unbalanced(moved, at, share, fps), _walks(moved, at, share)) if moved.travels else ()),
    )
    reasons = tuple(r for r in found if r is not None)
    return reasons if sum(r.weight for r in reasons) >= CLEAR else ()


def _part(clip: Clip) -> Clip:
    """The frames that are judged, see `MOST_FRAMES`."""
    every = max(1, int(clip.fps / ENOUGH_HZ)) if clip.frames > MANY_FRAMES else 1
    left = -(-clip.frames // every)
    first = max(0, left - MOST_FRAMES) // 2 * every
    part = slice(first, first + MOST_FRAMES * every, every)
    return clip.replaced(
        root_pos=clip.root_pos[part], rot=clip.rot[part], fps=clip.fps / every, cyclic=False
    )


def _file_rate(likely: float, fps: float) -> float:
    """The rate (Hz) near the likely one: a half, a quarter, double or four times of `fps`, since files
    are wrong by those, else the nearest that files have."""
    simple = min((fps * x for x in (0.25, 0.5, 2.0, 4.0)), key=lambda r: abs(math.log(r / likely)))
    rate = simple if abs(math.log(simple / likely)) < math.log(TOLD) else usual_rate(likely)
    usual = usual_rate(rate)
    return usual if abs(usual / rate - 1.0) < USUAL else rate


def _pulled(moved: Moved, at: float, share: float) -> Reason | None:
    part, spells = moved.pulled(at)
    if part < PULLED_SHARE or moved.pulled(share)[0] > LEFT * part:
        return None
    times = "once" if spells == 1 else f"{spells} times"
    says = f"{times} the body falls with more than {PULLED:g} times gravity, as no floor pulls it"
    return Reason("fall", CLEAR if spells > 1 else HINT, says)


def _unbalanced(moved: Moved, at: float, share: float, fps: float) -> Reason | None:
    part = moved.unbalanced(at)
    left = moved.unbalanced(share) if part >= UNBALANCED_HINT else math.inf
    if left > LEFT * part:
        return None
    says = (
        f"in {part:.0%} of the frames the floor's force would act beyond all that touches it "
        f"({left:.0%} at {fps * share:.4g} frames per second)"
    )
    return Reason("balance", CLEAR if part >= UNBALANCED else HINT, says)


def _walks(moved: Moved, at: float, share: float) -> Reason | None:
    gait = moved.gait
    if gait is None or gait.vault < VAULTS or not STEP_RATE / at < gait.rate <= STEP_RATE / share:
        return None
    fast = gait.froude * at**2 > FROUDE
    says = f"the body walks at {gait.speed:.1f} m/s with {gait.steps_s:.1f} steps per second"
    return Reason("gait", CLEAR if fast else HINT, says + ", as fast as people run" * fast)


def read_clip(path: str | Path, **stated: Any) -> Clip:
    """Reads a motion file as a clip in metres, Z up, see `poise.formats.read_clip`, which has the same
    arguments and errors.

    Where neither the file nor the caller states a frame rate, and the evidence against the usual one is
    clear, the rate that the motion has is taken (`settled`).
    """
    return settled(read_as_stated(path, **stated))


def settled(clip: Clip) -> Clip:
    """The clip at the rate that it has, of those that such files have (`Source.rates`), and a note that
    says why; as it is where a rate is stated, or where the usual one is not clearly wrong."""
    source = clip.skeleton.source
    if len(source.rates) < 2:
        return clip
    judged = judge_rate(clip)
    if judged.likely is None or judged.likely not in source.rates:
        return clip
    said = dict(source.evidence).get("fps", "")
    begins = said.partition(":")[0] or "The file states no frame rate"
    note = (
        f"{begins}: {judged.likely:g} frames per second taken, not {clip.fps:g}, at which {judged.why()}"
    )
    notes = tuple(note if n == said else n for n in source.notes)
    evidence = tuple((k, note if k == "fps" else v) for k, v in source.evidence)
    skeleton = clip.skeleton.with_source(notes=notes, evidence=evidence, rates=())
    return clip.replaced(skeleton=skeleton, fps=judged.likely)
