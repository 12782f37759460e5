"""Does a motion look physical: sliding, penetration, floating, jerk; and how much help it had.

No function but `detail` and `deviations` needs a reference. The same functions measure a reference and a
simulation, so that the two compare. Heights are metres above the ground, Z up; results are millimetres,
or as stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np

from poise.errors import PoiseError
from poise.metrics.tracking_errors import MM, PHC_FPS, masked_mean, masked_quantile, span_mask, steps
from poise.motion.rotations import GRAVITY
from poise.motion.vectors import Array, floored, limited, lower_median, namespace, norm, sliding

CONTACT_HEIGHT = 0.02
"""m; a foot point above this is not in contact."""
CONTACT_RISE = 0.2
"""m/s; a foot point that rises or falls faster is landing or leaving, not in contact."""
SWING_SPEED = 1.0
"""m/s; a foot point that is faster while another one is planted belongs to a swinging foot."""
BALLISTIC_TOLERANCE = 0.4
"""Share of g by which the vertical acceleration may differ from -g in flight."""
BALLISTIC_WINDOW = 0.1
"""s; time over which the vertical acceleration of the centre of mass is fitted."""


class Penetration(NamedTuple):
    """Depth under the ground, each `(...)`.

    Attributes:
        mean_mm: mean over all valid frames, mm.
        max_mm: deepest, mm.
        share: of the frames below the ground.
    """

    mean_mm: Any
    max_mm: Any
    share: Any


def _full(mask: Array | None, like: Array) -> Array:
    xp = namespace(like)
    return xp.ones_like(like, dtype=xp.bool) if mask is None else xp.broadcast_to(mask, like.shape)


def foot_contacts(
    foot_points: Array,
    fps: float,
    *,
    height: float = CONTACT_HEIGHT,
    ground: float = 0.0,
    mask: Array | None = None,
) -> tuple[Array, Array]:
    """Horizontal speed in mm/s and contact of each foot point between frames, both `(..., T - 1, F)`.

    A point `(..., T, F, 3)` is in contact from t to t+1 when it is within `height` m of the ground in
    both frames (deeper counts as in contact) and its vertical speed is at most `CONTACT_RISE`. A point
    faster than `SWING_SPEED` is left out while another point in contact is slower: it skims the
    ground in mid-swing. Where all points in contact are fast, the character skates and all count.
    """
    if foot_points.ndim < 3 or foot_points.shape[-1] != 3:
        raise PoiseError(
            f"foot points must be (..., T, F, 3), got {tuple(foot_points.shape)}", code="wrong-shape"
        )
    step = steps(foot_points) * fps
    low: Any = foot_points[..., 2] - ground <= height
    contact = low[..., 1:, :] & low[..., :-1, :] & (abs(step[..., 2]) <= CONTACT_RISE)
    if mask is not None:
        contact = contact & span_mask(mask, 1)[..., None]
    speed = norm(step[..., :2])
    planted = contact & (speed <= SWING_SPEED)
    contact = namespace(speed).where(planted.any(-1)[..., None], planted, contact)
    return speed * MM, contact


def foot_slide(
    foot_points: Array,
    fps: float,
    *,
    height: float = CONTACT_HEIGHT,
    ground: float = 0.0,
    mask: Array | None = None,
) -> Array:
    """Poise's foot slide, mm/s: mean horizontal speed of foot points while in contact; `(...)`.

    Contact as in `foot_contacts`; the mean runs over all (frame, point) pairs in contact. NaN
    without any contact. Hand in the points of all feet together.
    """
    speed, contact = foot_contacts(foot_points, fps, height=height, ground=ground, mask=mask)
    return masked_mean(speed, contact, (-2, -1))


def s2h_foot_penetration(height: Array) -> tuple[Array, Array]:
    """Skeleton2Humanoid's FP (mm, negative) and FQ (share) of joint heights `(..., T, J)` in m.

    The paper gives no formula; read as the means of `min(0, h)` and `[h < 0]` over all frames and
    the joints handed in (feet for FP and FQ, all joints for JQ).
    """
    under = namespace(height).astype(height < 0, height.dtype)
    return limited(height, most=0).mean((-2, -1)) * MM, under.mean((-2, -1))


def penetration(lowest: Array, mask: Array | None = None) -> Penetration:
    """Depth of the lowest point `(..., T)` m below the ground; results `(...)`.

    mean over all valid frames of `max(0, -h)`, frames without penetration counting zero.
    """
    valid = _full(mask, lowest)
    xp, depth = namespace(lowest), floored(-lowest, 0) * MM
    held = xp.where(valid, depth, xp.zeros_like(depth))
    under = masked_mean(xp.astype(depth > 0, depth.dtype), valid, -1)
    return Penetration(masked_mean(depth, valid, -1), xp.max(held, axis=-1), under)


def _window_any(flags: Array, half: int) -> Array:
    """True within `half` frames of a true flag, along the last dim."""
    if half == 0 or flags.shape[-1] == 0:
        return flags
    xp = namespace(flags)
    beside = xp.zeros((*flags.shape[:-1], half), dtype=xp.bool, device=flags.device)
    return sliding(xp.concat((beside, flags, beside), axis=-1), 2 * half + 1).any(-1)


def ballistic(com_height: Array, fps: float, mask: Array | None = None) -> Array:
    """Frames `(..., T)` in free flight, told from the centre of mass height `(..., T)` m alone.

    A parabola is fitted to every window of `BALLISTIC_WINDOW` (an odd number of frames, at least 3).
    Where its acceleration is -g within `BALLISTIC_TOLERANCE`, all frames of the window are in flight.
    The fit tells a jump from a character that hovers with an acceleration near zero.
    """
    half = max(1, int(BALLISTIC_WINDOW * fps / 2 + 1e-6))
    frames = com_height.shape[-1]
    xp = namespace(com_height)
    flags = xp.zeros_like(com_height, dtype=xp.bool)
    if frames < 2 * half + 1:
        return flags
    # Savitzky-Golay: z'' = 2 sum_k c_k z_{t+k},  c_k = (k^2 - m) / sum (k^2 - m)^2,  m = mean k^2
    k2 = xp.arange(-half, half + 1, dtype=com_height.dtype, device=com_height.device) ** 2
    c = k2 - k2.mean()
    c = 2.0 * c / (c * c).sum() * fps**2
    # Heights are taken relative to the window's middle, which keeps float32 exact enough.
    windows = sliding(com_height, 2 * half + 1)
    acceleration = ((windows - windows[..., half : half + 1]) * c).sum(-1)
    falling = abs(acceleration + GRAVITY) <= BALLISTIC_TOLERANCE * GRAVITY
    if mask is not None:
        falling = falling & span_mask(mask, 2 * half)
    flags[..., half : frames - half] = falling
    return _window_any(flags, half)


def float_gaps(
    lowest: Array, com_height: Array, fps: float, mask: Array | None = None
) -> tuple[Array, Array]:
    """Gap in mm between the lowest point and the ground, and where contact is due, both `(..., T)`.

    Contact is due in every frame that is not `ballistic`: nothing but the ground can hold a body
    that does not fall freely.
    """
    due = _full(mask, lowest) & ~ballistic(com_height, fps, mask)
    return floored(lowest, 0) * MM, due


def floating(lowest: Array, com_height: Array, fps: float) -> Array:
    """Mean gap, mm, between the lowest point `(..., T)` m and the ground where contact is due; `(...)`.

    See `float_gaps`. Frames that touch count zero; NaN when all frames are in flight.
    """
    return masked_mean(*float_gaps(lowest, com_height, fps), -1)


def jerk(pos: Array, fps: float) -> Array:
    """Mean over bodies of `||third difference|| fps^3`, m/s^3; `(..., T, B, 3)` gives `(..., T - 3)`."""
    return cast("Any", norm(steps(pos, 3)).mean(-1) * fps**3)


#: Bands (Hz) of `detail`: steps, gestures, what is quick.
DETAIL_HZ = ((0.5, 1.5), (1.5, 3.0), (3.0, 6.0), (6.0, 12.0))


def detail(pos: Array, ref: Array, fps: float) -> dict[str, float]:
    """How much of the reference's movement is left at each frequency: the ratio of the energies of
    bodies `(T, B, 3)` m about the root (body 0), by band ("1.5-3 Hz"). 1 keeps it, less is stiffer, more
    trembles.

    Energies are those of a Hann periodogram without the straight trend. A band that the clip is too
    short or too slow to tell is left out.
    """
    frames = len(pos)
    hz = np.fft.rfftfreq(frames, 1.0 / fps) if frames > 3 else np.zeros(1)
    t = np.linspace(-1.0, 1.0, frames)
    basis = np.stack((np.ones(frames), t), 1)

    def power(p: Any) -> np.ndarray:
        p = np.asarray(p, dtype=float)
        y = (p[:, 1:] - p[:, :1]).reshape(frames, -1)
        y = y - basis @ np.linalg.lstsq(basis, y)[0]
        spectrum = np.fft.rfft(y * np.hanning(frames + 2)[1:-1, None], axis=0)
        return np.square(np.abs(spectrum)).sum(1)

    out = dict[str, float]()
    if frames < 4:
        return out
    made, asked = power(pos), power(ref)
    for low, high in DETAIL_HZ:
        band = (hz >= low) & (hz < min(high, 0.5 * fps))
        if high - low > 2.0 * fps / frames and bool(band.any()) and float(asked[band].sum()) > 0.0:
            out[f"{low:g}-{high:g} Hz"] = float(made[band].sum() / asked[band].sum())
    return out


class Deviation(NamedTuple):
    """A spell in which a body is far from where the reference has it, as seen from the root.

    start_s, stop_s: s. body: its index. most_mm: the largest distance.
    """

    start_s: float
    stop_s: float
    body: int
    most_mm: float

    def told(self, names: Sequence[str]) -> dict[str, float | str]:
        """The score card's entry of `changed`, the body by its name."""
        return {**self._asdict(), "body": names[self.body]}


#: A deviation is at least so large (mm) and so many times the median distance, and lasts so long (s).
CHANGE_MM, CHANGE_TIMES, CHANGE_S = 60.0, 2.0, 0.1


def deviations(pos: Array, ref: Array, fps: float, most: int = 3) -> list[Deviation]:
    """The largest spells in which bodies `(T, B, 3)` m are not where `ref` has them, about body 0, the
    root, in the order of time: each over twice the median distance and `CHANGE_MM`, one body a spell.

    most: how many are given at most; spells of other bodies at the same time belong to the larger one.
    """
    about = (np.asarray(x, dtype=float) for x in (pos - pos[:, :1], ref - ref[:, :1]))
    off = norm(next(about) - next(about)) * MM
    if not off.size:
        return []
    least = max(CHANGE_MM, CHANGE_TIMES * float(lower_median(off[:, 1:])))
    found: list[Deviation] = []
    worst, far = off.argmax(1), off.max(1)
    edge = np.diff(np.pad(far > least, 1).astype(int))
    begins, ends = (np.flatnonzero(edge == k).tolist() for k in (1, -1))
    for start, stop in zip(begins, ends, strict=True):
        if stop - start >= CHANGE_S * fps:
            at = start + int(far[start:stop].argmax())
            found.append(Deviation(start / fps, stop / fps, int(worst[at]), float(far[at])))
    largest = sorted(found, key=lambda c: -c.most_mm)[:most]
    return sorted(largest, key=lambda c: c.start_s)


def smoothness(pos: Array, fps: float = PHC_FPS) -> Array:
    """Skeleton2Humanoid's SM: mean joint step, mm per frame at 30 Hz; `(..., T - 1)`.

    Compare it with the reference's value: a frozen character scores zero, so lower is not better.
    Other rates are rescaled by `fps / 30`.
    """
    return cast("Any", norm(steps(pos)).mean(-1) * (MM * fps / PHC_FPS))


@dataclass(frozen=True, eq=False)
class HelpAudit:
    """Help over the valid frames; zero wrenches give exactly zero.

    Norms are summed over bodies, not vectors: two opposite pushes on two bodies are help, not zero.

    Attributes:
        force_mean_n: N, mean over frames of `sum_m ||F_m||`.
        force_p95_n: N, its 95th percentile.
        torque_mean_nm: N m, mean over frames of `sum_m ||tau_m||`.
        torque_p95_nm: N m, its 95th percentile.
        work_j_per_s: J/s, mean over frames of `sum_m |F_m . v_m + tau_m . omega_m|`.
        share_of_body_weight: `force_mean_n / (m g)`.
        force_n: `(..., T)` N, per frame.
        torque_nm: `(..., T)` N m, per frame.
        power_w: `(..., T)` W, per frame.
    """

    force_mean_n: float
    force_p95_n: float
    torque_mean_nm: float
    torque_p95_nm: float
    work_j_per_s: float
    share_of_body_weight: float
    force_n: Any
    torque_nm: Any
    power_w: Any


def help_audit(
    force: Array,
    torque: Array,
    point_vel: Array,
    ang_vel: Array,
    mass: float,
    *,
    mask: Array | None = None,
) -> HelpAudit:
    """Audit the residual wrench of one body `(T, 3)` or of M bodies `(..., T, M, 3)`.

    Args:
        force, torque: N and N m, as applied (after clipping and the curriculum's scale).
        point_vel: m/s, velocity of the body at the point where the force acts.
        ang_vel: rad/s, the body's angular velocity. Force and velocity must share one frame, torque
            and angular velocity too (the world's, or the root's).
        mass: kg, the whole character.
        mask: `(..., T)` bool, valid frames.
    """
    parts = (force, torque, point_vel, ang_vel)
    if any(p.shape != force.shape for p in parts) or force.ndim < 2 or force.shape[-1] != 3:
        shapes = ", ".join(str(tuple(p.shape)) for p in parts)
        raise PoiseError(
            "force, torque, point_vel and ang_vel must share one shape, (T, 3) or (..., T, M, 3), "
            f"got {shapes}",
            code="wrong-shape",
        )
    if not mass > 0:
        raise PoiseError(f"the character's mass must be above 0 kg, got {mass}", code="out-of-range")
    if force.ndim == 2:
        force, torque, point_vel, ang_vel = (p[..., None, :] for p in parts)
    force_n = norm(force).sum(-1)
    torque_nm = norm(torque).sum(-1)
    # P_m = F_m . v_m + tau_m . omega_m; the sign is dropped: braking is help as much as driving.
    power_w = abs((force * point_vel).sum(-1) + (torque * ang_vel).sum(-1)).sum(-1)
    mask = _full(mask, force_n)
    force_mean = float(masked_mean(force_n, mask))
    return HelpAudit(
        force_mean_n=force_mean,
        force_p95_n=float(masked_quantile(force_n, 0.95, mask)),
        torque_mean_nm=float(masked_mean(torque_nm, mask)),
        torque_p95_nm=float(masked_quantile(torque_nm, 0.95, mask)),
        work_j_per_s=float(masked_mean(power_w, mask)),
        share_of_body_weight=force_mean / (mass * GRAVITY),
        force_n=force_n,
        torque_nm=torque_nm,
        power_w=power_w,
    )
