"""Joint speeds beyond what a human reaches, repaired over as few frames as possible."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.body import Anatomy
from poise.kin.series import fade_beside, find_runs, gaussian_sums
from poise.metrics import jerk
from poise.motion import Clip
from poise.spatial import normalize, quat_angle, quat_between, slerp, unwrap_quats

#: rad/s that no human joint reaches. Elbows come nearest to it: 2,300 degrees per second (40 rad/s) in
#: professional pitchers (Fleisig et al. 1999, J. Biomech. 32). Only their shoulders are faster, about
#: the long axis alone, where solvers fail most often, as a straight arm does not tell its twist.
ARM_SPEED = 40.0
#: The same for hips, ankles, trunk and neck, which are slower, so that noise is found earlier: the
#: fastest such turn in clean motion, the ankle of DeepMimic's spin kick, has 25 rad/s.
TRUNK_SPEED = 30.0
SLOW_PARTS = ("thigh", "foot", "spine", "neck", "head", "clavicle")
#: Spells closer than this (s) are one; the frames kept lie this far (s) from the damage.
GAP_S, MARGIN_S = 0.05, 0.017
#: Longest stretch (s) that is interpolated, and the longest at an end of the clip that is held.
LONGEST_S, END_S = 0.3, 0.1
#: Widest deviation (s) of the Gaussian that smooths what cannot be interpolated.
WIDEST_S = 0.1
#: A smoothed stretch is preferred where it changes this much less than an interpolated one.
CLEARLY_LESS = 0.7
#: A repair is undone where the clip jerks this many times as much there as it did anywhere before.
ROUGHER = 1.1


@dataclass(frozen=True)
class SpeedRepair:
    """Frames `start` to `stop` (inclusive) of one joint; its speed was brought into the human range.

    way: "interpolated", "held" (at an end of the clip) or "smoothed". before, after: largest speed,
    rad/s. change_deg: the largest turn away from what the file says.
    """

    joint: str
    start: int
    stop: int
    way: str
    before: float
    after: float
    change_deg: float


def speed_limits(clip: Clip, anatomy: Anatomy) -> list[float]:
    """The limit (rad/s) of every joint; joints that are no part of the body have the arm's."""
    kinds = {p.joint: p.kind for p in anatomy.parts}
    slow = [kinds.get(j) in SLOW_PARTS for j in range(len(clip.skeleton))]
    return [TRUNK_SPEED if s else ARM_SPEED for s in slow]


def limit_speeds(clip: Clip, anatomy: Anatomy) -> tuple[Clip, tuple[SpeedRepair, ...]]:
    """The clip with turns faster than a human joint repaired, and every repair.

    Steps above the limit are gathered into spells. A spell is replaced by a slerp over the shortest
    stretch around it with ends that can be joined at half the limit; at an end of the clip the joint is
    held. Where no stretch of `LONGEST_S` does, or where it would lead clearly farther from the file
    (a real turn, only too fast), the joint is smoothed there, as little as it takes.
    """
    rot = torch.tensor(clip.rot)
    found: list[SpeedRepair] = []
    for j, limit in enumerate(speed_limits(clip, anatomy)):
        track = unwrap_quats(rot[:, j])
        steps = _steps(track) * clip.fps
        if float(steps.max()) <= limit:
            continue
        for first, last in find_runs(steps.numpy() > limit, round(GAP_S * clip.fps)):
            # What lies farther away bears no part in a repair, so its time is that of the spell.
            base = max(0, first - _around(clip.fps))
            part = track[base : last + 2 + _around(clip.fps)]
            old = part.clone()
            way, (a, b) = _repair(part, first - base, last + 1 - base, limit, clip.fps)
            lo, hi = max(a + 1, 0), min(b - 1, len(part) - 1)
            change = _change(old, part)
            here = slice(max(lo - 1, 0), hi + 1)
            before, after = float(steps[first : last + 1].max()), float(_steps(part)[here].max())
            rot[base + lo : base + hi + 1, j] = normalize(part[lo : hi + 1])
            lo, hi = base + lo, base + hi
            found.append(
                SpeedRepair(
                    clip.skeleton.names[j], lo, hi, way, before, after * clip.fps, math.degrees(change)
                )
            )
    return (clip.replaced(rot=rot.numpy()), tuple(found)) if found else (clip, ())


def without_rougher(
    before: Clip, after: Clip, repairs: tuple[SpeedRepair, ...]
) -> tuple[Clip, tuple[SpeedRepair, ...], tuple[SpeedRepair, ...]]:
    """A clip with its speeds repaired but where that jerks the body more than anything did before.

    There many joints jump in one frame (frames are missing, or one joint undoes another), and only
    those above the limit would be made steady. Such spells stay as they were, with all repairs that
    touch them.

    Returns:
        the clip, the repairs that it has, and those that were undone.
    """
    undone: tuple[SpeedRepair, ...] = ()
    if not repairs or before.frames < 4:
        return after, repairs, undone
    most = ROUGHER * float(_shake(before).max())
    while True:
        # A third difference is of four frames.
        rough = torch.nonzero(_shake(after) > most).flatten().tolist()
        hit = tuple(r for r in repairs if any(r.start - 3 <= k <= r.stop for k in rough))
        if not hit:
            return after, repairs, undone
        rot = torch.tensor(after.rot)
        for r in hit:
            here, j = slice(r.start, r.stop + 1), before.skeleton.index(r.joint)
            rot[here, j] = torch.tensor(before.rot[here, j])
        after = after.replaced(rot=rot.numpy())
        repairs, undone = tuple(r for r in repairs if r not in hit), (*undone, *hit)


def _shake(clip: Clip) -> Tensor:
    return jerk(torch.tensor(clip.positions()), clip.fps)


def _around(fps: float) -> int:
    """Frames beside a spell that its repair looks at: twice the reach of the widest filter, or the
    longest stretch that is joined."""
    reach = math.ceil(3 * max(1.0, WIDEST_S * fps)) + 1
    return max(2 * reach, round((LONGEST_S + MARGIN_S) * fps) + 2) + 2


def _steps(track: Tensor) -> Tensor:
    """Angles (rad) between neighbouring frames."""
    return quat_angle(quat_between(track[:-1], track[1:]))


def _change(old: Tensor, new: Tensor) -> float:
    return float(quat_angle(quat_between(old, new)).max())


def _repair(track: Tensor, a: int, b: int, limit: float, fps: float) -> tuple[str, tuple[int, int]]:
    """Repairs frames a to b in place; how, and the unchanged frames on both sides."""
    old, smooth = track.clone(), track.clone()
    stretch = _shortest(track, a, b, limit, fps)
    if stretch is not None:
        _join(track, *stretch)
        if stretch[0] < 0 or stretch[1] >= len(track):
            return "held", stretch
        if stretch[1] - stretch[0] <= b - a + 2 * _margin(fps):
            return "interpolated", stretch
    sides = _smooth(smooth, a, b, limit, fps)
    calm = float(_steps(smooth)[max(sides[0], 0) : sides[1]].max()) * fps <= limit
    if stretch is None or (calm and _change(old, smooth) < CLEARLY_LESS * _change(old, track)):
        track[:] = smooth
        return "smoothed", sides
    return "interpolated", stretch


def _margin(fps: float) -> int:
    """Frames beside the damage that are not trusted either."""
    return max(1, round(MARGIN_S * fps)) - 1


def _shortest(track: Tensor, a: int, b: int, limit: float, fps: float) -> tuple[int, int] | None:
    """The kept frames next to the shortest stretch around frames a to b that can be joined.

    -1 or `len(track)` where the stretch reaches an end of the clip.
    """
    frames, margin = len(track), _margin(fps)
    a, b = a - margin, b + margin
    while b - a <= max(2, round(LONGEST_S * fps)):
        if a <= 0 or b >= frames - 1:
            short = b - a <= max(1, round(END_S * fps))
            return (-1 if a <= 0 else a, frames if b >= frames - 1 else b) if short else None
        turn = float(quat_angle(quat_between(track[a], track[b])))
        if turn * fps / (b - a) <= limit / 2:
            return a, b
        a, b = a - 1, b + 1
    return None


def _join(track: Tensor, a: int, b: int) -> None:
    """Slerp between frames a and b in place; one of them alone is held to the clip's end."""
    if a < 0:
        track[:b] = track[b]
    elif b >= len(track):
        track[a + 1 :] = track[a]
    else:
        t = torch.linspace(0.0, 1.0, b - a + 1, dtype=track.dtype)[1:-1]
        ends = track[a].expand(len(t), 4), track[b].expand(len(t), 4)
        track[a + 1 : b] = slerp(*ends, t)


def _smooth(track: Tensor, a: int, b: int, limit: float, fps: float) -> tuple[int, int]:
    """Blends in the Gaussian mean around frames a to b in place, with the least deviation that does."""
    original, frames, sigma = unwrap_quats(track), len(track), 1.0
    while True:
        mean, _, reach = gaussian_sums(original, sigma)
        # Full weight in the spell, falling to nothing over the filter's reach.
        track[:] = slerp(original, normalize(mean), fade_beside(frames, a, b, reach))
        lo, hi = max(a - reach, 0), min(b + reach, frames - 1)
        track[:lo], track[hi + 1 :] = original[:lo], original[hi + 1 :]
        if float(_steps(track)[lo:hi].max()) * fps <= limit or sigma * 1.5 > WIDEST_S * fps:
            return lo - 1, hi + 1
        sigma *= 1.5
