"""The motion doctor: what no body can have done in a clip, and what of it can be mended."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from poise.body import Anatomy
from poise.body.generate import asf_axis_quat
from poise.kinematics.coords import chain_angles
from poise.kinematics.hold import mend_path, mend_slides, steadied
from poise.kinematics.loops import best_period, overlap_of, repeated
from poise.kinematics.rate import judge_rate
from poise.kinematics.repair.estimate import CleanReport, clean_clip, denoise, noise_faults
from poise.kinematics.repair.faults import KINDS, Fault, by_kind, read_faults, spell_faults
from poise.kinematics.repair.speeds import jitter_faults, mend_jitter
from poise.kinematics.repair.support import (
    FloorPoints,
    anatomy_of,
    drifts,
    height_faults,
    slide_faults,
    support_of,
)
from poise.kinematics.repair.timing import (
    body_steps,
    mend_drift,
    mend_holds,
    mend_teleports,
    timing_faults,
)
from poise.kinematics.repair.turns import exchanged_sides
from poise.kinematics.travel import Travel, find_travel, in_place, travelled
from poise.metrics import floating, jerk, penetration
from poise.motion import Clip
from poise.motion.smoothing import smooth_lift

#: Degrees beyond a limit that a file states which count, and for how long (s): they are rough.
BEYOND_DEG, LASTING_S = 45.0, 0.1
#: How often feet are locked: a leg that is led back changes what its sole does.
SLIDE_ROUNDS = 3
#: The same of feet that trembled (`steadied`); the clip stays as high as it is up to this (m).
SHAKEN_ROUNDS, UNSURE_M = 2, 0.06
#: Periods of a loop that are mended, of which one is taken.
HEALED = 3


#: Kinds that tell how a file was written or read, not how the body moves.
READ_ONLY = ("bone drift", "quaternion length", "rest frame", "limit")


@dataclass(frozen=True)
class Examination:
    """What was found in a clip. figures: numbers to compare before and after a repair, None where
    they cannot be told. judged: whether the body could be told, so that feet and joints were judged.
    travel: what was taken out of a clip in place; its feet are judged with it. cleaned: the clip and
    what `clean_clip` makes of it, from which `heal` goes on."""

    faults: tuple[Fault, ...]
    figures: dict[str, float | None]
    judged: bool
    travel: Travel | None = None
    cleaned: tuple[Clip, Clip, CleanReport] | None = field(default=None, repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers."""
        return {
            "faults": [f.to_dict() for f in self.faults],
            "figures": dict(self.figures),
            "judged": self.judged,
            "in_place": None if self.travel is None else self.travel.to_dict(),
        }


def examine(clip: Clip) -> Examination:
    """All faults of a clip and its figures; nothing is changed.

    Faults of the frames and of the joints are told of the clip as it is, the stance of the feet too, but
    that of a clip in place with its travel.
    """
    anatomy = anatomy_of(clip)
    support = support_of(clip, anatomy)
    travel = None if support is None else support.travel
    if travel is not None:
        support = support_of(travelled(clip, travel.level), anatomy)
    cleaned, report = clean_clip(clip, anatomy, rougher=False)
    noise = report.noise
    if clip.skeleton.source.raw:
        # It is told all the same.
        noise = [replace(f, detail=f"{f.detail} (stays: raw)".strip()) for f in noise_faults(clip)[0]]
    faults = [*timing_faults(clip), *_joint_faults(report, clip), *noise]
    faults += [*jitter_faults(cleaned), *limit_faults(clip), *read_faults(clip)]
    if support is not None:
        faults += [
            *height_faults(clip, support),
            *slide_faults(clip, support),
            *_rate_faults(support, clip),
        ]
    if exchanged_sides(clip, anatomy):
        hint = "the joints named left lie on the body's right; --swap-sides exchanges the names"
        faults.append(Fault("sides", "", 0, clip.frames - 1, 1.0, hint))
    ordered = [f for group in by_kind(faults).values() for f in group]
    known = (clip, cleaned, report)
    return Examination(tuple(ordered), _figures(clip, support), support is not None, travel, known)


def heal(clip: Clip, path: bool | None = None, found: Examination | None = None) -> Clip:
    """The clip with everything mended that kinematics can mend; a clean clip comes back as it is.

    In this order: repeated frames, root teleports, joints that were lost, flips, speeds and noise
    (`clean_clip`), jitter in spells, a drifting height, the height above the floor, sliding feet. A step
    changes nothing if its faults are not there. path: whether the root's path is freed of the slip that
    standing feet have in common, or legs alone hold them; None frees it where both feet tell the same
    drift (`drifts`). found: what `examine` says of the clip, where that is known already.

    A clip in place is mended with its travel, and comes back in place, a loop as a loop.
    """
    anatomy = anatomy_of(clip)
    support = support_of(clip, anatomy)
    if support is None or support.travel is None:
        return _healed(clip, anatomy, path, found, support)
    travel, overlap = support.travel.level, overlap_of(clip)
    if overlap is None:
        moving = travelled(clip, travel)
        healed = _healed(moving, anatomy, path)
        return clip if healed is moving else in_place(healed, travel)
    # From the last frame of a loop it goes on to the first.
    closed = repeated(clip, overlap, 1)
    travel = (find_travel(closed) or travel).level
    moving = travelled(repeated(clip, overlap, HEALED), travel)
    healed = _healed(moving, anatomy, path)
    if healed is moving:
        return clip
    period = clip.frames - overlap
    return best_period(in_place(healed, travel), period, overlap, first=1).replaced(cyclic=clip.cyclic)


def without_noise(clip: Clip) -> tuple[Clip, CleanReport]:
    """The motion that a noisy clip was recorded of, which is followed in its place, and what was done.

    Where noise or lost joints are told, or reading took them off keypoints, it is what `heal` gives:
    standing feet are held, too, and the path is freed of the drift that both tell. Where that has other
    frames it is the clip without its noise alone. Any other clip comes back as it is, one with a raw
    source too.
    """
    if clip.skeleton.source.raw:
        return clip, CleanReport()
    found, whole = noise_faults(clip)
    if not found and not any(f.kind == "tremble" for f in read_faults(clip)):
        return clip, CleanReport()
    cleaned, report = clean_clip(clip, anatomy_of(clip), rougher=False)
    healed = heal(clip, found=Examination((), {}, False, cleaned=(clip, cleaned, report)))
    if healed.frames != clip.frames:
        calm = denoise(whole) if any(f.kind == "tremble" for f in found) else whole
        return calm, CleanReport(noise=found)
    return healed, replace(report, left=(), kept=())


def _supports(
    anatomy: Anatomy, clip: Clip, support: FloorPoints | None
) -> Callable[[Clip], FloorPoints | None]:
    """`support_of`, which knows that of the last clip: a step that changes nothing gives it back."""
    last = [(clip, support)]

    def of(clip: Clip) -> FloorPoints | None:
        if last[0][0] is not clip:
            last[0] = clip, support_of(clip, anatomy)
        return last[0][1]

    return of


def _healed(
    clip: Clip,
    anatomy: Anatomy,
    path: bool | None,
    found: Examination | None = None,
    known: FloorPoints | None = None,
) -> Clip:
    of = _supports(anatomy, clip, support_of(clip, anatomy) if known is None else known)
    clip = mend_holds(clip)
    support = of(clip)
    low = None if support is None else support.low.min(-1)
    clip = mend_teleports(clip, low)
    if found is not None and found.cleaned is not None and found.cleaned[0] is clip:
        _, clip, report = found.cleaned
    else:
        clip, report = clean_clip(clip, anatomy, rougher=False)
    clip = mend_jitter(clip)
    if support is None:
        return clip
    support = of(clip)
    clip = clip if support is None else mend_drift(clip, support.sole_low)
    # Feet that trembled still do a little where they stand; noise hides how high the floor is.
    noise = [*report.noise, *(f for f in read_faults(clip) if f.kind == "tremble")]
    shaken = any(f.kind == "tremble" for f in noise)
    support = of(clip)
    if support is not None and (not noise or abs(support.off_m) > UNSURE_M):
        clip = set_on_floor(clip, support)
    clip = _locked(clip, of, path, shaken)
    support = of(clip)
    return clip if support is None else set_on_floor(clip, support, whole=False)


def set_on_floor(clip: Clip, support: FloorPoints, whole: bool = True) -> Clip:
    """The clip lowered or lifted where it floats or lies under the floor, smoothly, else as it is.

    First the `whole` of it, by what its soles say; then spells that hover or sink, smoothed over 0.2 s.
    """
    off = support.off_m
    if off and not whole:
        return clip
    lift = np.full(clip.frames, -off)
    settle = support.fit.settle_m
    if any(
        f.kind == "float" and f.stop - f.start + 1 < clip.frames for f in height_faults(clip, support)
    ):
        lift -= settle
    # Points deeper than their margin come up to half of it, so that rounding leaves nothing behind.
    depth = np.where(support.depth > 0, support.depth + 0.5 * support.margin, 0.0).max(-1)
    if depth.any():
        lift += smooth_lift(depth, clip.fps, 0.1)
    if not lift.any():
        return clip
    return clip.replaced(root_pos=clip.root_pos + lift[:, None] * np.array([0.0, 0.0, 1.0]))


def _locked(
    clip: Clip, of: Callable[[Clip], FloorPoints | None], path: bool | None, shaken: bool
) -> Clip:
    """The clip without sliding feet. of: see `_supports`. path: see `heal`. shaken: whether they
    trembled."""
    for step in range(1 + SLIDE_ROUNDS):
        support = of(clip)
        if support is None:
            return clip
        faults = slide_faults(clip, support)
        if step == 0 and faults and (drifts(support) if path is None else path):
            clip = mend_path(clip, support, faults)
        elif step > 0 and shaken and step <= SHAKEN_ROUNDS:
            clip = steadied(clip, support)
        elif step > 0 and not shaken and faults:
            clip = mend_slides(clip, support, faults)
    return clip


def _joint_faults(report: CleanReport, clip: Clip) -> list[Fault]:
    out = [
        Fault("flip", f.joint, f.start, f.stop, f.before_deg, f"turned by {f.angle_deg:.0f} degrees")
        for f in report.flips
    ]
    out += [Fault("speed", s.joint, s.start, s.stop, s.before) for s in report.speeds]
    out += [Fault("joint jump", s.joint, s.start, s.stop, s.before) for s in report.kept]
    last = clip.frames - 1
    return out + [Fault("out of reach", joint, 0, last, float(n)) for joint, n in report.left]


def limit_faults(clip: Clip) -> list[Fault]:
    """Spells in which a joint is more than `BEYOND_DEG` beyond the file's own limits.

    Angles are the file's own degrees of freedom, continuous in time; each may be a whole turn away.
    """
    out: list[Fault] = []
    source = clip.skeleton.source
    if source.format != "asf-amc" or not source.channels:
        return out
    gap = round(0.1 * clip.fps)
    for j, channel in enumerate(source.channels):
        letters = [c[1].upper() for c in channel.order if c[0] == "r"]
        if j == 0 or not letters or len(channel.limits) != len(letters):
            continue
        axis = channel.axis or (0.0, 0.0, 0.0)
        frame = asf_axis_quat(axis, channel.axis_order, source.up_axis)
        # ASF lists the first-applied turn first, a chain its outermost hinge.
        low, high = np.array(channel.limits[::-1]).T
        middle = (low + high) / 2
        order = "".join(reversed(letters))
        angles = chain_angles(clip.rot[:, j], order, frame, middle)
        over = np.degrees(np.maximum(np.maximum(low - angles, angles - high), 0.0)).max(-1)
        found = spell_faults("limit", clip.skeleton.names[j], over, over > BEYOND_DEG, gap)
        out += [f for f in found if f.stop - f.start >= round(LASTING_S * clip.fps)]
    return out


def _rate_faults(support: FloorPoints, clip: Clip) -> list[Fault]:
    judged = judge_rate(clip, support.table)
    if judged.likely is None:
        return []
    detail = f"{judged.why()}; state it with --fps {judged.likely:g}"
    return [Fault("frame rate", "", 0, clip.frames - 1, judged.likely, detail)]


def _figures(clip: Clip, support: FloorPoints | None) -> dict[str, float | None]:
    """Measures of the whole clip; lengths are told against the floor at z = 0."""
    pos = clip.positions()
    shake = jerk(pos, clip.fps)
    step = np.linalg.norm(np.diff(clip.root_pos, axis=0), axis=-1)
    out: dict[str, float | None] = {
        "sole_slide_mm_per_s": None,
        "penetration_mm": None,
        "penetration_max_mm": None,
        "float_mm": None,
        "jerk_m_per_s3": float(shake.mean()) if len(shake) else 0.0,
        "jerk_max_m_per_s3": float(shake.max()) if len(shake) else 0.0,
        "root_step_max_mm": float(step.max()) * 1e3,
        "joint_speed_max_rad_per_s": float(body_steps(clip).max()) * clip.fps,
    }
    if support is not None:
        lowest = support.low.min(-1)
        depth = penetration(lowest)
        gap = floating(support.sole_low, support.com[:, 2], clip.fps)
        out["sole_slide_mm_per_s"] = support.sole_slide
        out["penetration_mm"], out["penetration_max_mm"] = _number(depth.mean_mm), _number(depth.max_mm)
        out["float_mm"] = _number(gap)
    return out


def _number(value: np.ndarray) -> float | None:
    return float(value) if math.isfinite(float(value)) else None


def new_faults(name: str, before: Examination, after: Examination) -> list[str]:
    """One sentence on the kinds of faults that a motion has more of than another, [] without any."""
    old, told = by_kind(before.faults), list[str]()
    for kind, faults in by_kind(after.faults).items():
        more = len(faults) - len(old.get(kind, ()))
        if more <= 0 or kind in READ_ONLY:
            continue
        worst = max(faults, key=lambda f: f.size)
        where = f"{worst.joint} " if worst.joint else ""
        size = f"{worst.size:.3g} {KINDS[kind].unit}".strip()
        times = f"{more} more" if kind in old else f"{more}"
        told.append(f"{times} of '{kind}' (the worst {size}, {where}{worst.start}-{worst.stop})")
    if not told:
        return []
    return [
        f"{name}: poise doctor finds in the written motion what the clip has not: {', '.join(told)}."
    ]
