"""Joint speeds beyond what a human reaches, and bones that tremble between neighbouring frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from poise.body import Anatomy
from poise.kinematics.repair.faults import Fault, spell_faults
from poise.metrics import jerk
from poise.motion import Clip
from poise.motion.rotations import (
    normalize,
    quat_angle,
    quat_between,
    quat_mul,
    quat_rotate,
    quat_to_rotvec,
    slerp,
    unwrap_quats,
)
from poise.motion.smoothing import fade_beside, find_runs, gaussian_sums
from poise.motion.vectors import norm, running_median

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
    rot = clip.rot.copy()
    found: list[SpeedRepair] = []
    for j, limit in enumerate(speed_limits(clip, anatomy)):
        track = unwrap_quats(rot[:, j])
        steps = _steps(track) * clip.fps
        if float(steps.max()) <= limit:
            continue
        for first, last in find_runs(steps > limit, round(GAP_S * clip.fps)):
            # What lies farther away bears no part in a repair, so its time is that of the spell.
            base = max(0, first - _around(clip.fps))
            part = track[base : last + 2 + _around(clip.fps)]
            old = part.copy()
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
    return (clip.replaced(rot=rot), tuple(found)) if found else (clip, ())


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
        rough = np.flatnonzero(_shake(after) > most).tolist()
        hit = tuple(r for r in repairs if any(r.start - 3 <= k <= r.stop for k in rough))
        if not hit:
            return after, repairs, undone
        rot = after.rot.copy()
        for r in hit:
            here, j = slice(r.start, r.stop + 1), before.skeleton.index(r.joint)
            rot[here, j] = before.rot[here, j]
        after = after.replaced(rot=rot)
        repairs, undone = tuple(r for r in repairs if r not in hit), (*undone, *hit)


def _shake(clip: Clip) -> np.ndarray:
    return jerk(clip.positions(), clip.fps)


def _around(fps: float) -> int:
    """Frames beside a spell that its repair looks at: twice the reach of the widest filter, or the
    longest stretch that is joined."""
    reach = math.ceil(3 * max(1.0, WIDEST_S * fps)) + 1
    return max(2 * reach, round((LONGEST_S + MARGIN_S) * fps) + 2) + 2


def _steps(track: np.ndarray) -> np.ndarray:
    """Angles (rad) between neighbouring frames."""
    return quat_angle(quat_between(track[:-1], track[1:]))


def _change(old: np.ndarray, new: np.ndarray) -> float:
    return float(quat_angle(quat_between(old, new)).max())


def _repair(track: np.ndarray, a: int, b: int, limit: float, fps: float) -> tuple[str, tuple[int, int]]:
    """Repairs frames a to b in place; how, and the unchanged frames on both sides."""
    old, smooth = track.copy(), track.copy()
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


def _shortest(track: np.ndarray, a: int, b: int, limit: float, fps: float) -> tuple[int, int] | None:
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


def _join(track: np.ndarray, a: int, b: int) -> None:
    """Slerp between frames a and b in place; one of them alone is held to the clip's end."""
    if a < 0:
        track[:b] = track[b]
    elif b >= len(track):
        track[a + 1 :] = track[a]
    else:
        t = np.linspace(0.0, 1.0, b - a + 1, dtype=track.dtype)[1:-1]
        ends = np.broadcast_to(track[a], (len(t), 4)), np.broadcast_to(track[b], (len(t), 4))
        track[a + 1 : b] = slerp(*ends, t)


def _smooth(track: np.ndarray, a: int, b: int, limit: float, fps: float) -> tuple[int, int]:
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


#: Noise (m, rms) of the root, and of one end of a bone against the other, that counts as trembling.
ROOT_M, BONE_M = 0.003, 0.003
#: Fourth differences exceed second ones this much only above a quarter of the frame rate:
#: |2 sin(x / 2)|^2 is 2 at x = pi / 2. White noise has sqrt(70 / 6) = 3.4.
SHARP = 2.0
#: Half the window (s) over which both are averaged, and how many frames at least.
WINDOW_S, WINDOW_FRAMES = 0.1, 8
#: Spells nearer than this (s) are one.
JITTER_GAP_S = 0.15
#: Deviations (frames) of the Gaussian that smooths, the first that suffices; the largest in seconds.
SIGMAS, JITTER_WIDEST_S = (0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0), 0.05


def trembling(path: np.ndarray, fps: float, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Noise `(T)` in the unit of `path (T, n)`, and where it exceeds `limit` and is as sharp as noise.

    White noise of deviation s has fourth differences of deviation sqrt(70) s, and second ones that are
    `SHARP` times smaller or less. Of both the median over a window around each frame counts, so that a
    foot that strikes or a single jump is no noise.
    """
    frames = len(path)
    half = max(WINDOW_FRAMES, round(WINDOW_S * fps))
    if frames < 2 * half + 1:
        return np.zeros(frames), np.zeros(frames, dtype=bool)
    # A fourth difference is centred on its third frame, a second difference on its second.
    high, low = (
        running_median(np.pad(norm(np.diff(path, n=n, axis=0)), n // 2, mode="edge"), half)
        for n in (4, 2)
    )
    size = high / math.sqrt(70.0)
    return size, (size > limit) & (high > SHARP * low)


def jitter_faults(clip: Clip) -> list[Fault]:
    """Bones that tremble, in mm of one end against the other, and a root path that does.

    The joint that is named is the one with a rotation that trembles, not those that only ride on it.
    """
    gap, least = round(JITTER_GAP_S * clip.fps), WINDOW_FRAMES
    out = []
    size, bad = trembling(clip.root_pos, clip.fps, ROOT_M)
    out += spell_faults("root jitter", clip.skeleton.names[0], size * 1e3, bad, gap, least)
    rot, world = clip.rot.copy(), clip.world()[1]
    for j, bones in enumerate(_bones(clip)):
        for bone in bones:
            size, bad = _bone_noise(world[:, j], bone, clip.fps, BONE_M)
            if not bad.any():
                continue
            own = _bone_noise(rot[:, j], bone, clip.fps, 0.7 * BONE_M)[1]
            name = clip.skeleton.names[j]
            found = spell_faults("jitter", name, size * 1e3, bad & own, gap, least)
            if found:
                out += found
                break
    return out


def mend_jitter(clip: Clip) -> Clip:
    """The clip smoothed where bones or the root tremble, as little as it takes; else as it is.

    A Gaussian mean, which shifts nothing in time, is blended in over the spell and its reach; its
    deviation is the smallest of `SIGMAS` after which the noise is below its limit. Rotations are
    smoothed in the world's frame, since in a captured chain the noise of one joint undoes that of the
    next.
    """
    skeleton = clip.skeleton
    root = _smoothed(clip.root_pos, clip.fps, ROOT_M, None)
    rot, world = clip.rot.copy(), clip.world()[1]
    smooth = [_smoothed_bones(world[:, j], bones, clip.fps) for j, bones in enumerate(_bones(clip))]
    if root is None and all(s is None for s in smooth):
        return clip
    out, turned = rot.copy(), world.copy()
    for j, parent in enumerate(skeleton.parents):
        above = turned[:, parent] if parent >= 0 else None
        if smooth[j] is None and (above is None or _calmer(rot[:, j], world[:, j])):
            # Calm against its parent: it rides along.
            turned[:, j] = rot[:, j] if above is None else quat_mul(above, rot[:, j])
            continue
        own = smooth[j]
        turned[:, j] = world[:, j] if own is None else own
        local = turned[:, j] if above is None else quat_between(above, turned[:, j])
        changed = (turned[:, j] != world[:, j]).any(-1)
        if parent >= 0:
            changed |= (turned[:, parent] != world[:, parent]).any(-1)
        out[changed, j] = normalize(local[changed])
    path = clip.root_pos if root is None else root
    return clip.replaced(root_pos=path, rot=unwrap_quats(out))


def _bones(clip: Clip) -> list[list[np.ndarray]]:
    """Per joint the vectors (m, its own frame) to its children and tips, the longest first."""
    skeleton = clip.skeleton
    out: list[list[np.ndarray]] = [[] for _ in range(len(skeleton))]
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            out[parent].append(skeleton.offsets[j])
    for j, tip in skeleton.tips:
        out[j].append(np.asarray(tip, dtype=float))
    return [sorted((v for v in b if float(norm(v)) > 0.01), key=lambda v: -float(norm(v))) for b in out]


def _bone_noise(
    track: np.ndarray, bone: np.ndarray, fps: float, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    return trembling(quat_rotate(track, np.broadcast_to(bone, (len(track), 3))), fps, limit)


def _calmer(local: np.ndarray, world: np.ndarray) -> bool:
    """Whether a joint trembles less against its parent than in the world."""
    return bool(_shaking(local) <= _shaking(world))


def _shaking(track: np.ndarray) -> np.ndarray:
    steps = quat_to_rotvec(quat_between(track[:-1], track[1:]))
    return np.square(np.diff(steps, n=3, axis=0)).mean() if len(steps) > 3 else steps.sum() * 0


def _smoothed_bones(track: np.ndarray, bones: list[np.ndarray], fps: float) -> np.ndarray | None:
    tries = (_smoothed(unwrap_quats(track), fps, BONE_M, bone) for bone in bones)
    return next((t for t in tries if t is not None), None)


def _smoothed(path: np.ndarray, fps: float, limit: float, bone: np.ndarray | None) -> np.ndarray | None:
    """The path without its noise, None where it has none; with a `bone`, a path of its rotations."""

    def noise(now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return trembling(now, fps, limit) if bone is None else _bone_noise(now, bone, fps, limit)

    first = noise(path)
    spells = spell_faults("jitter", "", *first, round(JITTER_GAP_S * fps), WINDOW_FRAMES)
    out = path
    for spell in spells:
        here = slice(spell.start, spell.stop + 1)
        before = out
        for sigma in SIGMAS:
            if sigma > max(SIGMAS[0], JITTER_WIDEST_S * fps):
                break
            out = _blend(before, spell.start, spell.stop, sigma)
            out = out if bone is None else normalize(out)
            if not noise(out)[1][here].any():
                break
    return out if spells else None


def _blend(path: np.ndarray, start: int, stop: int, sigma: float) -> np.ndarray:
    """The Gaussian mean inside the spell, the path itself beyond the filter's reach."""
    total, weights, reach = gaussian_sums(path, sigma)
    weight = fade_beside(len(path), start, stop, reach + 1)[..., None]
    return path + weight * (total / weights - path)
