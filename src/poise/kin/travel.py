"""Motion in place: the travel that was taken out of a clip, told by the limbs that bear it.

A foot that bears stands still in the world. In a clip in place it goes backwards
instead, with all other feet that bear, and the root stays where it is. The motion in the world is

    x_world = G(t) x,    G' = G xi,    xi p = v + w z x p = -p'    for every point p that bears,

so that the twist xi = (v, w) is fitted to the velocities p' of points that bear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from poise.body import BodyTable, generate_table
from poise.errors import PoiseError
from poise.kin.bearing import (
    SLOWEST,
    Bearing,
    Fit,
    along_of,
    bearing_of,
    fit_of,
    flat_speed,
    is_clear,
    solved,
    weighted_median,
)
from poise.kin.series import gaussian
from poise.motion import Clip
from poise.spatial import axis_angle_to_quat, heading_quat, quat_conj, quat_mul

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
            table = generate_table(clip.skeleton, None, [clip])
        except PoiseError:
            return None
    joints = [r.joint for r in table.rows]
    pos, quat = (x[:, joints] for x in clip.world())
    return told_by(table, torch.tensor(pos), torch.tensor(quat), clip.fps)


def told_by(table: BodyTable, pos: torch.Tensor, quat: torch.Tensor, fps: float) -> Travel | None:
    """`find_travel` of a body with rows in the world poses `pos (T, B, 3)` m, `quat (T, B, 4)`."""
    root = pos[:, 0, :2].numpy()
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


def _stays(fit: Fit, root: np.ndarray, quat: torch.Tensor, seconds: float) -> bool:
    """Whether the root ends where it began, and turned as it began, beside what was taken out."""
    way = float(np.linalg.norm(root[-1] - root[0]))
    if way > STAYS * seconds * max(math.hypot(*fit.twist[:2]), SLOWEST):
        return False
    turned = heading_quat(quat_mul(quat, quat_conj(quat[:1])))
    heading = np.unwrap(2 * np.arctan2(turned[:, 3].numpy(), turned[:, 0].numpy()))
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
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    rot = np.array(clip.rot)
    rot[:, 0] = quat_mul(axis_angle_to_quat(up, torch.tensor(angle)), torch.tensor(rot[:, 0])).numpy()
    return clip.replaced(root_pos=root, rot=rot)
