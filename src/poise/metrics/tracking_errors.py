"""How closely a motion follows its reference: position, velocity and acceleration errors, success.

Positions are `(..., T, B, 3)` in metres, world, Z up; errors are in millimetres per frame. The
definitions are those of UHC's and PHC's evaluation (Luo et al. 2021, 2023).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, cast

from poise.errors import PoiseError, did_you_mean
from poise.metrics.shape_points import Shapes, lowest_points
from poise.motion.rotations import best_rotation
from poise.motion.vectors import Array, floored, like, namespace, norm, sliding

MM = 1000.0
PHC_FPS = 30.0
"""PHC's velocity and acceleration errors are differences between frames at this rate."""


def _check_pair(pos: Array, ref: Array) -> None:
    if pos.shape != ref.shape or pos.ndim < 3 or pos.shape[-1] != 3:
        raise PoiseError(
            "positions and reference must both be (..., T, B, 3), "
            f"got {tuple(pos.shape)} and {tuple(ref.shape)}",
            code="wrong-shape",
        )


def steps(x: Array, order: int = 1) -> Array:
    """Differences of order `order` between frames: `(..., T, B, 3)` gives `(..., T - order, B, 3)`."""
    for _ in range(order):
        x = x[..., 1:, :, :] - x[..., :-1, :, :]
    return x


def _check_fps(fps: float) -> None:
    if not 0 < fps < float("inf"):
        raise PoiseError(f"the frame rate must be above 0, got {fps}", code="rate-out-of-range")


def mpjpe_global(pos: Array, ref: Array) -> Array:
    """Mean per-joint position error in the world, mm: `mean_j ||p_j - p_ref,j||`; returns `(..., T)`."""
    _check_pair(pos, ref)
    return cast("Any", norm(pos - ref).mean(-1) * MM)


def has_lost(pos: Array, ref: Array) -> Array:
    """Whether characters have lost their motion: the mean distance of the bodies `(..., B, 3)` m exceeds
    `LOST`, or is no number; `(...)` bool. The one criterion by which that is judged, while characters
    act as afterwards."""
    # Written as "not within" so that NaN counts as lost.
    return cast("Any", ~(norm(pos - ref).mean(-1) <= LOST))


def mpjpe_root(pos: Array, ref: Array, root: int = 0) -> Array:
    """MPJPE after each side's own root position is subtracted, mm; returns `(..., T)`.

    The root itself counts with error zero, as in PHC. Heading is not aligned.
    """
    _check_pair(pos, ref)
    local = pos - pos[..., root : root + 1, :]
    local_ref = ref - ref[..., root : root + 1, :]
    return cast("Any", norm(local - local_ref).mean(-1) * MM)


def mpjpe_pa(pos: Array, ref: Array) -> Array:
    """MPJPE after the best similarity (rotation, translation, scale) per frame, mm; returns `(..., T)`.

    Procrustes: with centred X, Y the rotation R of `Y^T X` (`rotations.best_rotation`), with the
    singular values S D, and `s = tr(S D) / ||X||^2` minimise `||s R x - y||^2`. Reflections are
    excluded.
    """
    _check_pair(pos, ref)
    xp = namespace(pos)
    x, y = (xp.astype(p, xp.float64) for p in (pos, ref))
    x, y = x - x.mean(-2)[..., None, :], y - y.mean(-2)[..., None, :]
    rotation, values = best_rotation(y.mT @ x)
    scale = values.sum(-1) / floored((x * x).sum((-1, -2)), 1e-18)
    fitted = scale[..., None, None] * (x @ rotation.mT)
    return xp.astype(norm(fitted - y).mean(-1) * MM, pos.dtype)


def velocity_error(pos: Array, ref: Array, fps: float = PHC_FPS) -> Array:
    """Velocity error in PHC's unit, mm per frame at 30 Hz; returns `(..., T - 1)`.

    `mean_j ||(p_{t+1} - p_t) - (p_ref,t+1 - p_ref,t)||`. Motions at another rate are rescaled to
    the 30 Hz definition by `fps / 30` (mm in 1/30 s); they are not resampled, so noise above
    15 Hz counts at high rates and cannot be seen at 30 Hz.
    """
    _check_pair(pos, ref)
    _check_fps(fps)
    return cast("Any", norm(steps(pos - ref)).mean(-1) * (MM * fps / PHC_FPS))


def acceleration_error(pos: Array, ref: Array, fps: float = PHC_FPS) -> Array:
    """Acceleration error in PHC's unit, mm per frame^2 at 30 Hz; returns `(..., T - 2)`.

    `mean_j ||second difference of (p - p_ref)||`, rescaled by `(fps / 30)^2` for other rates
    (see `velocity_error` for what that means).
    """
    _check_pair(pos, ref)
    _check_fps(fps)
    return cast("Any", norm(steps(pos - ref, 2)).mean(-1) * (MM * (fps / PHC_FPS) ** 2))


#: m, the mean distance of the bodies from their reference beyond which a motion is lost.
LOST = 0.5


@dataclass(frozen=True)
class SuccessRule:
    """A named failure test; an episode succeeds when no frame fails.

    Attributes:
        name: under which scores are reported.
        measure: "mean" or "max": that of `||p - p_ref||` over bodies must stay within `limit_m`.
            "below_min": the root must not sink more than `limit_m` below the lowest reference root.
            "below_ref": nor more than `limit_m` below the reference root of the same frame.
        limit_m: m.
        source: the paper or code that uses it.
    """

    name: str
    measure: Literal["mean", "max", "below_min", "below_ref"]
    limit_m: float
    source: str


RULES: Mapping[str, SuccessRule] = MappingProxyType(
    {
        r.name: r
        for r in (
            SuccessRule("phc", "mean", LOST, "mean over bodies: UHC's and PHC's evaluation"),
            SuccessRule("phc_strict", "max", 0.5, "any body: the strict evaluation of PHC's code"),
            SuccessRule("any_25cm", "max", 0.25, "any body: where PHC's code ends training"),
            SuccessRule("rfc_height", "below_min", 0.1, "root height: RFC's code"),
            SuccessRule("s2h_root", "below_ref", 0.5, "root height: Skeleton2Humanoid, CRP"),
        )
    }
)
"""Success rules by name. Rates under different rules must not be compared: always name the rule."""


def success_rule(rule: str | SuccessRule) -> SuccessRule:
    """The rule of that name; an unknown name is answered with the nearest one."""
    if isinstance(rule, SuccessRule):
        return rule
    if rule not in RULES:
        raise PoiseError(
            f"there is no success rule '{rule}'",
            hint=did_you_mean(rule, tuple(RULES)),
            code="unknown-choice",
        )
    return RULES[rule]


class Outcome(NamedTuple):
    """Whether and where episodes fail.

    Attributes:
        success: `(...)` bool.
        first_fail: `(...)` long, the first failing frame, -1 where none fails.
    """

    success: Any
    first_fail: Any


def success(
    pos: Array,
    ref: Array,
    lengths: Array,
    rule: str | SuccessRule = "phc",
    *,
    bodies: Sequence[int] | None = None,
    root: int = 0,
    ref_min_height: Array | None = None,
) -> Outcome:
    """Which episodes follow their reference to the end, and where the others first fail.

    Args:
        pos, ref: `(..., T, B, 3)` m, padded after `lengths (...)` frames; padding is not looked at.
        rule: a name in `RULES`, or a rule. A distance equal to the limit still passes; a position
            that is not finite fails. An episode without frames does not succeed.
        bodies: indices the distances are taken over (PHC leaves out toes and hands); all by default.
        root: index of the root body, for the height rules.
        ref_min_height: `(...)` m, lowest reference root height of the whole clip ("rfc_height");
            by default the lowest within the episode.
    """
    _check_pair(pos, ref)
    chosen = success_rule(rule)
    if lengths.shape != pos.shape[:-3]:
        raise PoiseError(
            f"lengths must be {tuple(pos.shape[:-3])}, got {tuple(lengths.shape)}", code="wrong-shape"
        )
    xp = namespace(pos)
    valid = xp.arange(pos.shape[-3], device=pos.device) < lengths[..., None]
    if chosen.measure in ("mean", "max"):
        picked = slice(None) if bodies is None else list(bodies)
        distance = norm((pos - ref)[..., picked, :])
        measured = distance.mean(-1) if chosen.measure == "mean" else xp.max(distance, axis=-1)
    else:
        level = ref[..., root, 2]
        if chosen.measure == "below_min":
            if ref_min_height is None:
                ref_min_height = xp.min(xp.where(valid, level, xp.full_like(level, xp.inf)), axis=-1)
            level = cast("Any", ref_min_height)[..., None]
        measured = level - pos[..., root, 2]
    # Written as "not within" so that NaN counts as a failure.
    bad = ~(measured <= chosen.limit_m) & valid
    failed = bad.any(-1)
    first = _first(bad)
    return Outcome(~failed & (lengths > 0), first)


UPRIGHT_DEG = 45.0
"""Degrees from the vertical up to which a trunk is upright, in the reference."""
FALLEN_DEG = 60.0
"""Degrees beyond which a character's trunk is not, where the reference's is."""
HEAD_SHARE = 0.8
"""Of the reference's height of the head; kneeling it is at 0.7 of standing."""
FOOT_M = 0.05
"""m; a reference is on its feet where one of them is this near the ground."""
OFF_M = 0.1
"""m; a character is off its feet where all of them are higher."""
LASTING_S = 0.5
"""s; shorter spells are a stumble or a hop."""


def fallen(pos: Array, ref: Array, head: int, root: int = 0) -> Array:
    """Frames `(..., T)` in which the reference is upright and the character is not.

    With d the way from the root to the head and z up, the reference is upright where the angle of d and
    z is at most `UPRIGHT_DEG`. The character has fallen there if its own angle is above `FALLEN_DEG`, or
    its head lower than `HEAD_SHARE` of the reference's.

    Args:
        pos, ref: `(..., T, B, 3)` m.
    """
    lean, own = (_lean(x[..., head, :] - x[..., root, :]) for x in (ref, pos))
    low = pos[..., head, 2] < HEAD_SHARE * ref[..., head, 2]
    return (lean <= math.radians(UPRIGHT_DEG)) & ((own > math.radians(FALLEN_DEG)) | low)


def off_feet(
    pos: Array, quat: Array, ref: Array, ref_quat: Array, shapes: Shapes, feet: tuple[int, ...]
) -> Array:
    """Frames `(..., T)` in which the reference has a foot within `FOOT_M` of the ground, and the
    character none within `OFF_M`.

    Args:
        pos, ref: `(..., T, B, 3)` m. quat, ref_quat: `(..., T, B, 4)` wxyz.
        feet: the bodies that are feet; their shapes tell heights.
    """
    own = shapes.of_bodies(feet)
    height, stands = (lowest_points(*x, own) for x in ((pos, quat), (ref, ref_quat)))
    return (stands <= FOOT_M) & (height > OFF_M)


def first_lasting(bad: Array, fps: float) -> Array:
    """`(...)` long, the first frame of a spell of `bad (..., T)` that lasts `LASTING_S`, else -1."""
    frames = max(1, round(LASTING_S * fps))
    if bad.shape[-1] < frames:
        xp = namespace(bad)
        return xp.full(bad.shape[:-1], -1, dtype=xp.int64, device=bad.device)
    return _first(cast("Any", sliding(bad, frames).all(-1)))


def _first(flags: Array) -> Array:
    """`(...)`, the first that holds of `flags (..., T)`, -1 where none does."""
    xp = namespace(flags)
    first = xp.argmax(xp.astype(flags, xp.int64), axis=-1)
    return xp.where(flags.any(-1), first, -xp.ones_like(first))


def _lean(way: Array) -> Array:
    """Angle (rad) of vectors `(..., 3)` and the vertical."""
    return namespace(way).atan2(norm(way[..., :2]), way[..., 2])


def span_mask(mask: Array, order: int) -> Array:
    """Which of the `T - order` differences of order `order` use valid frames only.

    mask: `(..., T)` bool. Returns `(..., T - order)` bool, aligned with differences of that order.
    """
    frames = mask.shape[-1]
    out = mask[..., : max(frames - order, 0)]
    for k in range(1, order + 1):
        out = out & mask[..., k : max(frames - order, 0) + k]
    return out


def masked_mean(x: Array, mask: Array | None = None, dim: int | tuple[int, ...] | None = None) -> Array:
    """Mean of `x` where `mask` (of the same shape) holds; NaN where nothing is valid.

    Values under a false mask may be anything, NaN too. `dim=None` reduces everything.
    """
    xp, dims = namespace(x), tuple(range(x.ndim)) if dim is None else dim
    valid: Any = xp.ones_like(x, dtype=xp.bool) if mask is None else mask
    if valid.shape != x.shape:
        raise PoiseError(
            f"the mask has shape {tuple(valid.shape)}, the values {tuple(x.shape)}", code="wrong-shape"
        )
    total, count = xp.where(valid, x, xp.zeros_like(x)).sum(dims), valid.sum(dims)
    return xp.where(count > 0, total / floored(count, 1), xp.full_like(total, xp.nan))


def masked_quantile(x: Array, q: float, mask: Array | None = None) -> Array:
    """The quantile `q` in [0, 1] of all valid values, linear between neighbours; NaN without any."""
    values = namespace(x).sort(x.reshape(-1) if mask is None else x[mask])
    if not len(values):
        return like(math.nan, x)
    place = q * (len(values) - 1)
    low = int(place)
    high = min(low + 1, len(values) - 1)
    return values[low] + (place - low) * (values[high] - values[low])
