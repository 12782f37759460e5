"""Motion in place: the travel that was taken out of a clip, told by the limbs that bear it.

A foot that bears stands still in the world. In a clip in place it goes backwards instead, with all other
feet that bear, and the root stays where it is. The motion in the world is

    x_world = G(t) x,    G' = G xi,    xi p = v + w z x p = -p'    for every point p that bears,

so that the twist xi = (v, w) is fitted to the velocities p' of points that bear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from poise.body import BodyTable, body_of
from poise.errors import PoiseError
from poise.kinematics.feet import NEAR_M
from poise.kinematics.forward import extreme_points
from poise.motion import Clip
from poise.motion.rotations import axis_angle_to_quat, heading_quat, quat_conj, quat_mul
from poise.motion.smoothing import gaussian

#: Limbs that may bear: a crawl's hands and knees count as feet do.
BEARS = ("foot", "hand", "shin")
#: A point bears up to this height (m) over the lowest of its frame, and leaves or lands where it rises
#: or falls faster than the first (m/s) and this share of its own speed.
WITH_M, RISE_SPEED, RISE_SHARE = 0.03, 0.2, 0.25
#: Soles that come to rest this much (m) higher than others have a floor of their own.
OWN_FLOOR_M = 0.015
#: Slowest travel (m/s) that is told from slides, and what a turn makes of points that bear (m/s, rms).
SLOWEST, SLOWEST_SPIN = 0.2, 0.08
#: Velocities this near to the travel's (m/s, and share of its speed) are steady.
STEADY, STEADY_SHARE = 0.12, 0.25
#: Share of their way that limbs go along the travel: all of them, and each.
ALONG, ALONG_EACH = 0.8, 0.6
#: Share of the bearing time in which a limb may stand still, slower than this share of the travel.
STANDS, STILL = 0.3, 0.3
#: The limb that bears second most does so for this share of the other's time, and goes as fast within
#: this ratio.
BOTH, ALIKE = 0.35, 2.0
#: Rounds in which limbs that skim the floor in their swing are told from those that bear.
ROUNDS = 8


class Bearing(NamedTuple):
    """What limbs do from frame to frame while they bear.

    weight: `(T - 1, L)`, how surely each bears, 0 to 1. velocity, place: `(T - 1, L, 3)` m/s and m, of
    its points that bear. spin: `(T - 1, L)` rad/s, of them about each other, seen from above. size:
    `(T - 1, L)` m^2, their mean squared distance from their middle.
    """

    weight: np.ndarray
    velocity: np.ndarray
    place: np.ndarray
    spin: np.ndarray
    size: np.ndarray

    @property
    def speed(self) -> np.ndarray:
        """`(T - 1, L)` m/s, rms of the points that bear."""
        flat = np.square(self.velocity[..., :2]).sum(-1)
        return np.sqrt(flat + self.size * self.spin**2)


class Fit(NamedTuple):
    """A travel fitted to what limbs do.

    twist: v_x, v_y m/s of a body at the centre, and w rad/s. going: `(T - 1, L, 2)` m/s, how it lets
    limbs go that bear, and size: `(T - 1, L)` m/s, rms of all their points. weight: `(T - 1, L)`, those
    that bear, at most 1 a frame. off: `(T - 1, L)`, how far each is from `going`, 1 where it is not
    steady. left: m/s, rms of what is not explained.
    """

    twist: np.ndarray
    going: np.ndarray
    size: np.ndarray
    weight: np.ndarray
    off: np.ndarray
    left: float


def bearing_of(table: BodyTable, pos: np.ndarray, quat: np.ndarray, fps: float) -> Bearing:
    """A point bears the more surely the lower it is: in its frame, and over the floor of the clip."""
    weights, velocities, places = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    spins, sizes = list[np.ndarray](), list[np.ndarray]()
    rows = [i for i, r in enumerate(table.rows) if r.kind in BEARS]
    limbs = [extreme_points(table, pos, quat, [i]) for i in rows]
    middles = [0.5 * (p[1:] + p[:-1]) for p in limbs]
    floors = [float(np.quantile(m[..., 2].min(-1), 0.05)) for m in middles]
    floor = min(floors, default=0.0)
    # Soles of a measured body differ by a centimetre or two; a limb that comes as low has its own.
    heights = [
        m[..., 2] - (own if own - floor < OWN_FLOOR_M else floor)
        for m, own in zip(middles, floors, strict=True)
    ]
    lows = np.min([h.min(-1) for h in heights], axis=0)
    for points, middle, z in zip(limbs, middles, heights, strict=True):
        u = np.diff(points, axis=0) * fps
        leaves = np.abs(u[..., 2]) > RISE_SPEED + RISE_SHARE * np.linalg.norm(u[..., :2], axis=-1)
        sure = np.clip(1 - z / NEAR_M, 0, 1) * np.clip(1 - (z - lows[:, None]) / WITH_M, 0, 1)
        sure[leaves] = 0.0
        share = (sure / np.maximum(sure.sum(-1, keepdims=True), 1e-9))[..., None]
        weights.append(sure.max(-1))
        velocity, place = (share * u).sum(1), (share * middle).sum(1)
        arm, du = (middle - place[:, None])[..., :2], (u - velocity[:, None])[..., :2]
        size = (share * arm**2).sum((1, 2))
        turned = (share[..., 0] * (arm[..., 0] * du[..., 1] - arm[..., 1] * du[..., 0])).sum(1)
        velocities.append(velocity)
        places.append(place)
        spins.append(turned / np.maximum(size, 1e-6))
        sizes.append(size)
    return Bearing(*(np.stack(x, 1) for x in (weights, velocities, places, spins, sizes)))


def fit_of(bearing: Bearing, centre: np.ndarray, turn: bool) -> Fit:
    """Robust least squares. In every frame the limb that agrees best bears, another where it agrees as
    well: feet that are led low over the floor in their swing look like feet that bear."""
    weight, u = _shared(bearing.weight), bearing.velocity
    twist = np.array([-weighted_median(u[..., k], weight) for k in range(2)] + [0.0])
    if turn:
        twist = solved(weight, bearing, centre, turn)
    for _ in range(ROUNDS):
        off = np.where(bearing.weight > 0, _off(twist, bearing, centre)[2], np.inf)
        bears = off <= np.maximum(off.min(1, keepdims=True), 1.0)
        weight = _shared(np.where(bears, bearing.weight, 0.0))
        twist = solved(weight / np.maximum(off, 1.0), bearing, centre, turn)
    going, size, off = _off(twist, bearing, centre)
    wide = STEADY + STEADY_SHARE * size
    left = math.sqrt(float((weight * (np.minimum(off, 2.0) * wide) ** 2).sum() / weight.sum()))
    return Fit(twist, going, size, weight, off, left)


def _off(
    twist: np.ndarray, bearing: Bearing, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """See `Fit`: going, size and off of a twist."""
    arm = bearing.place[..., :2] - centre
    going = -np.stack((twist[0] - twist[2] * arm[..., 1], twist[1] + twist[2] * arm[..., 0]), -1)
    size = np.sqrt(np.square(going).sum(-1) + bearing.size * twist[2] ** 2)
    apart = np.square(bearing.velocity[..., :2] - going).sum(-1)
    # Feet pivot as they walk; only of a turn is it asked how they spin.
    spin = bearing.size * (bearing.spin + twist[2]) ** 2 if twist[2] else 0.0
    return going, size, np.sqrt(apart + spin) / (STEADY + STEADY_SHARE * size)


def _shared(weight: np.ndarray) -> np.ndarray:
    """Weights that sum to at most 1 in every frame."""
    return weight / np.maximum(weight.sum(1, keepdims=True), 1.0)


def weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    """The value with half of the weight on either side."""
    order = np.argsort(values, axis=None)
    total = np.cumsum(weight.ravel()[order])
    return float(values.ravel()[order][np.searchsorted(total, 0.5 * total[-1])])


def solved(weight: np.ndarray, bearing: Bearing, centre: np.ndarray, turn: bool) -> np.ndarray:
    """v_x, v_y, w that minimise sum weight |v + w z x arm + u|^2 of all points; without a turn w = 0."""
    w = (weight / max(float(weight.sum()), 1e-9))[..., None]
    u, arm = bearing.velocity[..., :2], bearing.place[..., :2] - centre
    mean_u, mean_arm, spin = (w * u).sum((0, 1)), (w * arm).sum((0, 1)), 0.0
    if turn:
        du, da = u - mean_u, arm - mean_arm
        own = w[..., 0] * bearing.size
        inertia = float((w * da**2).sum() + own.sum())
        spin = (w[..., 0] * (da[..., 0] * du[..., 1] - da[..., 1] * du[..., 0])).sum()
        spin = -float(spin + (own * bearing.spin).sum()) / max(inertia, 1e-9)
    return np.array([spin * mean_arm[1] - mean_u[0], -spin * mean_arm[0] - mean_u[1], spin])


def along_of(fit: Fit, bearing: Bearing) -> np.ndarray:
    """`(T - 1, L)` m/s, how fast what bears goes the way of the travel, times its weight."""
    way = (bearing.velocity[..., :2] * fit.going).sum(-1)
    way = way - bearing.size * bearing.spin * fit.twist[2]
    return fit.weight * way / np.maximum(fit.size, 1e-9)


def is_clear(fit: Fit, bearing: Bearing) -> bool:
    """Whether what bears goes along the travel, at least two limbs do, and none stands still."""
    along, speed, size = (
        along_of(fit, bearing),
        bearing.speed if fit.twist[2] else flat_speed(bearing),
        fit.size,
    )
    slowest = SLOWEST_SPIN if fit.twist[2] else SLOWEST
    if float((fit.weight * size).sum()) < slowest * float(fit.weight.sum()):
        return False
    way = fit.weight * speed
    stands = float(bearing.weight[speed < STILL * size].sum() / bearing.weight.sum())
    if along.sum() < ALONG * way.sum() or stands > STANDS:
        return False
    bears = fit.weight.sum(0)
    most = np.argsort(-bears)[:2]
    if len(most) < 2 or bears[most[1]] < BOTH * bears[most[0]]:
        return False
    each = [along[:, k].sum() / max((fit.weight * size)[:, k].sum(), 1e-9) for k in most]
    steady = all(along[:, k].sum() >= ALONG_EACH * way[:, k].sum() for k in most)
    return bool(steady and min(each) > 0 and max(each) <= ALIKE * min(each))


def flat_speed(bearing: Bearing) -> np.ndarray:
    """`(T - 1, L)` m/s of the middle of what bears."""
    return np.linalg.norm(bearing.velocity[..., :2], axis=-1)


#: Slowest turn (rad/s) that is told.
SLOWEST_TURN = 0.4
#: Slowest rise (m/s) and least slope of stairs; share of the time in which limbs sink or rise with it.
SLOWEST_RISE, SLOPE, RISING = 0.1, 0.15, 0.8
#: A travel is steady where what bears is for this share of the time.
STEADY_TIME = 0.8
#: A turn must leave less than this share of the velocities that a travel without it leaves.
TURN_GAIN = 0.6
#: What the root may do: stray (m); end elsewhere, or turned, by this share of the travel; and turn (rad)
#: between two steps.
STRAYS_M, STAYS, TURNED = 0.6, 0.15, math.radians(45.0)
#: Deviation (s) of the Gaussian over which an unsteady travel is smoothed.
SMOOTH_S = 0.08
#: Speed (m/s) beyond which it is said to run.
RUNS = 2.5


@dataclass(frozen=True, eq=False)
class Travel:
    """What was taken out of a clip.

    Attributes:
        velocity: m/s, x, y, z in the world of the clip, of a body at `centre`.
        turning: rad/s about the vertical, counterclockwise from above.
        centre: `(2,)` m, the root's mean place.
        share: of the way that bearing limbs go in the clip, how much is along the travel, 0 to 1.
        steps: `(T - 1, 3)` m/s, velocity from frame to frame; all `velocity` where the travel is steady.
    """

    velocity: tuple[float, float, float]
    turning: float
    centre: tuple[float, float]
    share: float
    steps: np.ndarray

    @property
    def speed(self) -> float:
        """Horizontal speed, m/s."""
        return math.hypot(*self.velocity[:2])

    def scaled(self, scale: float, about: np.ndarray) -> Travel:
        """The travel of a body that is `scale` times as large, about the place `about (2,)` m."""
        if scale == 1.0:
            return self
        x, y = (float(a + scale * (c - a)) for a, c in zip(about, self.centre, strict=True))
        fast = tuple(scale * v for v in self.velocity)
        return replace(self, velocity=fast, centre=(x, y), steps=scale * self.steps)

    @property
    def level(self) -> Travel:
        """The travel without its rise: what is judged on the floor of the clip."""
        steps = self.steps * np.array([1.0, 1.0, 0.0])
        return replace(self, velocity=(*self.velocity[:2], 0.0), steps=steps)

    def words(self) -> str:
        """What the clip does, without a subject: "walks in place at 1.1 m/s"."""
        turns = f"at {math.degrees(abs(self.turning)):.0f} degrees/s"
        if self.speed < SLOWEST:
            return f"turns in place {turns}"
        told = f"{'runs' if self.speed > RUNS else 'walks'} in place at {_figure(self.speed)} m/s"
        if self.velocity[2]:
            way = "up" if self.velocity[2] > 0 else "down"
            told += f" and {_figure(abs(self.velocity[2]))} m/s {way}"
        return f"{told}, turning {turns}" if self.turning else told

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "velocity_m_per_s": list(self.velocity), "speed_m_per_s": self.speed,
            "turning_rad_per_s": self.turning, "share": self.share, "said": self.words(),
        }  # fmt: skip


def _figure(speed: float) -> str:
    return f"{speed:.1f}" if speed >= 0.95 else f"{speed:.2f}"


def find_travel(clip: Clip, table: BodyTable | None = None) -> Travel | None:
    """The travel that was taken out of a clip; None where it travels, stands, or that is not clear.

    It is clear where at least two limbs bear in turn and go along one travel, as fast as each other,
    while none stands still and the root stays where it is.

    Args:
        table: the body of the clip's skeleton, where there is one.
    """
    if table is None:
        try:
            table = body_of(clip)
        except PoiseError:
            return None
    joints = [r.joint for r in table.rows]
    pos, quat = (x[:, joints] for x in clip.world())
    return told_by(table, pos, quat, clip.fps)


def told_by(table: BodyTable, pos: np.ndarray, quat: np.ndarray, fps: float) -> Travel | None:
    """`find_travel` of a body with rows in the world poses `pos (T, B, 3)` m, `quat (T, B, 4)`."""
    root = pos[:, 0, :2]
    if len(root) < 4 or np.ptp(root, axis=0).max() > STRAYS_M:
        return None
    bearing = bearing_of(table, pos, quat, fps)
    centre = root.mean(0)
    if bearing.weight.sum() < 1e-6:
        return None
    straight, turned = (fit_of(bearing, centre, turn) for turn in (False, True))
    turns = abs(turned.twist[2]) >= SLOWEST_TURN and turned.left < TURN_GAIN * straight.left
    best = turned if turns and is_clear(turned, bearing) else straight
    seconds = (len(root) - 1) / fps
    if not is_clear(best, bearing) or not _stays(best, root, quat[:, 0], seconds):
        return None
    return _described(best, bearing, centre, fps)


def _stays(fit: Fit, root: np.ndarray, quat: np.ndarray, seconds: float) -> bool:
    """Whether the root ends where it began, and turned as it began, beside what was taken out."""
    way = float(np.linalg.norm(root[-1] - root[0]))
    if way > STAYS * seconds * max(math.hypot(*fit.twist[:2]), SLOWEST):
        return False
    turned = heading_quat(quat_mul(quat, quat_conj(quat[:1])))
    heading = np.unwrap(2 * np.arctan2(turned[:, 3], turned[:, 0]))
    turns = abs(fit.twist[2]) * seconds
    # A heading that turns alone means a path that bends, of which the speed alone was taken out.
    return abs(float(heading[-1] - heading[0])) <= max(STAYS * turns, TURNED)


def _described(fit: Fit, bearing: Bearing, centre: np.ndarray, fps: float) -> Travel:
    u, steady = bearing.velocity, np.where(fit.off <= 1.0, fit.weight, 0.0)
    even = float(steady.sum()) >= STEADY_TIME * float(fit.weight.sum())
    turning = float(fit.twist[2])
    speed = bearing.speed if turning else flat_speed(bearing)
    share = float(along_of(fit, bearing).sum() / (fit.weight * speed).sum())
    frames = len(u)
    if even or turning:
        v = solved(steady if even else fit.weight, bearing, centre, bool(turning))
        steps = np.tile((v[0], v[1], 0.0), (frames, 1))
        turning = float(v[2])
    else:
        steps = _unsteady(fit.weight, u, fps)
    speed = math.hypot(*steps[:, :2].mean(0))
    rise = -weighted_median(u[..., 2], fit.weight)
    same = float(fit.weight[np.sign(u[..., 2]) == -math.copysign(1, rise)].sum() / fit.weight.sum())
    if same >= RISING and abs(rise) >= max(SLOWEST_RISE, SLOPE * speed):
        steps[:, 2] = rise
    x, y, z = (float(s) for s in steps.mean(0))
    return Travel((x, y, z), turning, (float(centre[0]), float(centre[1])), share, steps)


def _unsteady(weight: np.ndarray, u: np.ndarray, fps: float) -> np.ndarray:
    """`(T - 1, 3)` m/s of a travel that goes by fits and starts: what bears tells it, smoothed; between,
    as in flight, it goes on from one to the next."""
    total = weight.sum(1)
    at = np.flatnonzero(total > 0)
    mean = -(weight[..., None] * u).sum(1)[at] / total[at, None]
    frames, kernel = np.arange(len(u)), gaussian(SMOOTH_S * fps)
    reach = len(kernel) // 2
    out = np.zeros((len(u), 3))
    for k in range(2):
        path = np.interp(frames, at, mean[:, k], period=len(u))
        padded = (
            np.pad(path, reach, mode="wrap") if reach <= len(u) else np.pad(path, reach, mode="edge")
        )
        out[:, k] = np.convolve(padded, kernel, "valid")
    return out


def travelled(clip: Clip, travel: Travel) -> Clip:
    """The clip with the travel that was taken out of it; of a repeated clip of as many as it fits."""
    return moved_by(clip, *path_of(travel, clip.frames, clip.fps))


def in_place(clip: Clip, travel: Travel) -> Clip:
    """What a body made of a clip with the travel, without it again: the inverse of `travelled`."""
    place, angle = path_of(travel, clip.frames, clip.fps)
    turn = np.stack((np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)), -1)
    back = -np.einsum("tij,ti->tj", turn.reshape(-1, 2, 2), place[:, :2])
    return moved_by(clip, np.concatenate((back, -place[:, 2:]), -1), -angle)


def path_of(travel: Travel, frames: int, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """G(t) of every frame: a place `(T, 3)` m and an angle `(T)` rad about the vertical.

    Of clips of several periods the steps are repeated.
    """
    angle = travel.turning * np.arange(frames) / fps
    steps = travel.steps[np.arange(frames - 1) % len(travel.steps)]
    centre = np.array(travel.centre)
    # xi about the world's origin: v - w z x centre.
    v = steps[:, :2] - travel.turning * np.array([-centre[1], centre[0]])
    half = angle[:-1] + 0.5 * travel.turning / fps
    # The chord of an arc lies in the direction in the middle, shorter by sin(x) / x.
    short = np.sinc(0.5 * travel.turning / fps / math.pi)
    c, s = np.cos(half), np.sin(half)
    step = short * np.stack((c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]), -1) / fps
    step = np.concatenate((step, steps[:, 2:] / fps), -1)
    return np.concatenate((np.zeros((1, 3)), np.cumsum(step, axis=0))), angle


def moved_by(clip: Clip, place: np.ndarray, angle: np.ndarray) -> Clip:
    """Every frame turned by `angle (T)` about the world's vertical, then moved by `place (T, 3)`."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = clip.root_pos.T
    root = np.stack((c * x - s * y, s * x + c * y, z), -1) + place
    if not angle.any():
        return clip.replaced(root_pos=root)
    up = np.array([0.0, 0.0, 1.0], dtype=float)
    rot = np.array(clip.rot)
    rot[:, 0] = quat_mul(axis_angle_to_quat(up, angle), rot[:, 0])
    return clip.replaced(root_pos=root, rot=rot)
