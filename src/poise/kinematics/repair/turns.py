"""Feet and hands turned half a turn away from where they can be; left and right exchanged."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from poise.body import Anatomy
from poise.motion import Clip, Skeleton
from poise.motion.clip_info import sampled
from poise.motion.role_words import name_words, without_rig
from poise.motion.rotations import (
    normalize,
    quat_angle,
    quat_between,
    quat_mul,
    quat_rotate,
    quat_to_rotvec,
    rotvec_to_quat,
)
from poise.motion.smoothing import find_runs
from poise.motion.vectors import cross, lower_median, norm

#: Angles (rad) from the neutral pose that no foot or hand reaches. A foot: 50 degrees of plantar flexion
#: (American Academy of Orthopaedic Surgeons) and about twice that in a ballet dancer on pointe, to which
#: up to 45 degrees about the shin come where a skeleton's knee is a pure hinge. A hand: 80 degrees of
#: flexion on top of 90 of pronation, which some skeletons put into the wrist.
UNREACHABLE = {"foot": math.radians(120.0), "hand": math.radians(150.0)}
#: A flip is a turn of at least this angle (rad); turned back, the joint lies this near to neutral.
HALF_TURN, HOME = math.radians(150.0), math.radians(60.0)
#: Gaps (s) that belong to one spell, and how far (s) from its ends the jumps are looked for.
GAP_S, REACH_S = 0.05, 0.06


@dataclass(frozen=True)
class Flip:
    """Frames `start` to `stop` (inclusive) of one joint that were turned back by `angle_deg` degrees.

    before_deg, after_deg: the median angle from the neutral pose.
    """

    joint: str
    start: int
    stop: int
    angle_deg: float
    before_deg: float
    after_deg: float


def unflip(clip: Clip, anatomy: Anatomy, speed: float) -> tuple[Clip, tuple[Flip, ...]]:
    """The clip with flipped feet and hands turned back, and what was turned.

    A spell is a flip where the joint is farther from its neutral pose than it can reach (see
    `UNREACHABLE`) and gets there or back in a jump faster than `speed` rad/s; a spell that lasts the
    whole clip has no jump and counts only where the rest pose stands and is flipped by half a turn. The
    spell is turned back about one axis of the joint's own frame: a principal axis of the foot or hand,
    since mirrored solutions of a solver lie there, or the axis of the jump itself where that is a
    single step and leads nearer to neutral.
    """
    rot = clip.rot.copy()
    neutral, stands = neutral_pose(clip, anatomy)
    found: list[Flip] = []
    for part in anatomy.parts:
        limit = UNREACHABLE.get(part.kind)
        if limit is None:
            continue
        j, home = part.joint, neutral[part.joint]
        away = _from(home, rot[:, j])
        for start, stop in find_runs(away > limit, round(GAP_S * clip.fps)):
            whole = start == 0 and stop == clip.frames - 1
            if whole and not (stands and float(lower_median(away)) > HALF_TURN):
                continue
            if not whole and not _jumps(rot[:, j], start, stop, speed / clip.fps, clip.fps):
                continue
            axes = _own_axes(clip.skeleton, j)
            back = _turn_back(rot[:, j], start, stop, home, axes, speed / clip.fps)
            if back is None:
                continue
            spell = slice(start, stop + 1)
            fixed = normalize(quat_mul(rot[spell, j], back))
            turned, before, after = (
                quat_angle(back),
                lower_median(away[spell]),
                lower_median(_from(home, fixed)),
            )
            rot[spell, j] = fixed
            numbers = [math.degrees(float(x)) for x in (turned, before, after)]
            found.append(Flip(clip.skeleton.names[j], start, stop, *numbers))
    return (clip.replaced(rot=rot), tuple(found)) if found else (clip, ())


def out_of_reach(clip: Clip, anatomy: Anatomy) -> tuple[tuple[str, int], ...]:
    """(joint, frames) of feet and hands that are where none reaches."""
    neutral, _ = neutral_pose(clip, anatomy)
    out = []
    for part in anatomy.parts:
        if part.kind in UNREACHABLE:
            away = _from(neutral[part.joint], clip.rot[:, part.joint])
            frames = int((away > UNREACHABLE[part.kind]).sum())
            out += [(clip.skeleton.names[part.joint], frames)] if frames else []
    return tuple(out)


def neutral_pose(clip: Clip, anatomy: Anatomy) -> tuple[np.ndarray, bool]:
    """`(J, 4)` wxyz local rotations from which reach is measured, and whether they are the rest pose.

    Identity where the rest pose stands: its ankles lie below the hips by nearly the length of the
    legs. Otherwise (LAFAN1 and Bandai lie folded at identity) each joint's mean over the clip.
    """
    skeleton = clip.skeleton
    rest = skeleton.rest_positions()
    identity = np.zeros((len(skeleton), 4))
    identity[:, 0] = 1.0
    drops = []
    for thigh, shin, foot in zip(*(anatomy.of(k) for k in ("thigh", "shin", "foot")), strict=True):
        leg = np.linalg.norm(rest[shin] - rest[thigh]) + np.linalg.norm(rest[foot] - rest[shin])
        drops.append((rest[thigh, 2] - rest[foot, 2]) / max(float(leg), 1e-9))
    if drops and min(drops) > 0.9:
        return identity, True
    rot = clip.rot.copy()
    # The principal eigenvector of the sum of q q^T (Markley et al. 2007).
    mean = np.linalg.eigh(np.einsum("tja,tjb->jab", rot, rot)).eigenvectors[..., -1]
    return mean, False


def _from(home: np.ndarray, rot: np.ndarray) -> np.ndarray:
    return quat_angle(quat_between(home, rot))


def _jumps(rot: np.ndarray, start: int, stop: int, step: float, fps: float) -> bool:
    """Whether some step near either end of the spell is larger than `step` rad."""
    steps = quat_angle(quat_between(rot[:-1], rot[1:]))
    reach = max(1, round(REACH_S * fps))
    # Step k leads from frame k to frame k + 1.
    ends = [steps[max(start - reach, 0) : start + reach]] if start else []
    ends += [steps[max(stop - reach, 0) : stop + reach]] if stop < len(rot) - 1 else []
    return any(bool((e > step).any()) for e in ends)


def _own_axes(skeleton: Skeleton, joint: int) -> np.ndarray:
    """`(3, 3)` unit rows in the joint's frame: along its bone, and two across it."""
    tips = [skeleton.offsets[c] for c in skeleton.children(joint)]
    tips += [np.array(v) for j, v in skeleton.ends if j == joint]
    tips = [v for v in tips if np.linalg.norm(v) > 1e-3] or [np.array([1.0, 0.0, 0.0])]
    along = max(tips, key=lambda v: float(np.linalg.norm(v)))
    up = np.array([0.0, 0.0, 1.0], dtype=float)
    if norm(cross(along, up)) < 0.1 * norm(along):
        up = np.array([1.0, 0.0, 0.0], dtype=float)
    across = cross(up, along)
    return normalize(np.stack((along, across, cross(along, across))))


def _turn_back(
    rot: np.ndarray, start: int, stop: int, home: np.ndarray, axes: np.ndarray, step: float
) -> np.ndarray | None:
    """The turn (wxyz, joint's frame) that brings the spell nearest to neutral, if any brings it home."""
    turns = list(rotvec_to_quat(axes * math.pi))
    own = _jump_turn(rot, start, stop, step)
    if own is not None:
        turns.append(own)
    spell = rot[start : stop + 1]
    rest = [float(lower_median(_from(home, quat_mul(spell, t)))) for t in turns]
    best = int(np.argmin(rest))
    return turns[best] if rest[best] < HOME else None


def _jump_turn(rot: np.ndarray, start: int, stop: int, step: float) -> np.ndarray | None:
    """The turn that undoes the jumps at the ends of a spell, where they are one clean step each."""
    turns = []
    for inner, outer, way in ((start, start - 1, -1), (stop, stop + 1, 1)):
        if not 0 <= outer + way < len(rot):
            continue
        drift = quat_between(rot[outer + way], rot[outer])
        if quat_angle(drift) > step:
            return None
        # Where the joint would have been, had it gone on as it did outside the spell.
        expected = quat_mul(rot[outer], drift)
        turns.append(quat_between(rot[inner], expected))
    if not turns or min(float(quat_angle(t)) for t in turns) < HALF_TURN:
        return None
    if len(turns) == 2:
        if quat_angle(quat_between(turns[0], turns[1])) > math.radians(15.0):
            return None
        second = turns[1] if float(turns[0] @ turns[1]) > 0 else -turns[1]
        turns = [normalize(turns[0] + second)]
    return rotvec_to_quat(quat_to_rotvec(turns[0]))


#: Share of frames by which the votes of the geometry must agree before they contradict the names.
SURE = 0.5
_PAIRS = ("thigh", "upper_arm")


def side_votes(clip: Clip, anatomy: Anatomy) -> dict[str, float]:
    """What tells the body's left, each from -1 (the names are exchanged) to 1 (they are right).

    With `up` from pelvis to chest and `forward`, left is up x forward. Forward is where the feet point
    ("feet"), where the bent knees point ("knees"), and where the walk leads ("travel"); the hips and
    shoulders named left should lie on that side of those named right. Sources that tell nothing (no
    toes, straight legs, standing) are left out.
    """
    at = sampled(clip.frames, 200)
    part = clip.replaced(root_pos=clip.root_pos[at], rot=clip.rot[at]) if len(at) > 1 else clip
    pos = part.positions()
    chest = anatomy.of("spine") or anatomy.of("neck") or anatomy.of("head")
    if not anatomy.parts or not chest:
        return {}
    up = _unit(pos[:, chest[-1]] - pos[:, anatomy.of("pelvis")[0]])
    across = np.zeros_like(up)
    for kind in _PAIRS:
        left, right = anatomy.of(kind, "left"), anatomy.of(kind, "right")
        if left and right:
            across += _unit(pos[:, left[0]] - pos[:, right[0]])
    out = {}
    for name, forward in _forwards(clip, anatomy, part, pos, up).items():
        left_w = np.cross(up, forward)
        told = np.linalg.norm(left_w, axis=-1) > 1e-9
        if told.any():
            out[name] = float(np.sign((left_w * across).sum(-1))[told].mean())
    return out


def exchanged_sides(clip: Clip, anatomy: Anatomy) -> bool:
    """Whether the joints named left lie on the body's right: exchanged names or mirrored axes.

    Feet and knees must agree, as far as they tell anything; travel alone proves nothing, since people
    also walk backwards.
    """
    votes = side_votes(clip, anatomy)
    told = [votes[k] for k in ("feet", "knees") if k in votes]
    return bool(told) and max(told) < -SURE


def swap_sides(clip: Clip) -> Clip:
    """The clip with the names of left and right joints exchanged; joints without a twin keep theirs."""
    names = clip.skeleton.names
    words = [name_words(n) for n in without_rig(names)]
    keys = [(w.side, w.tokens, w.number) for w in words]
    twin = {"left": "right", "right": "left"}
    out = list(names)
    for j, (side, tokens, number) in enumerate(keys):
        other = (twin.get(side, ""), tokens, number)
        if side and keys.count(other) == 1 and keys.count(keys[j]) == 1:
            out[j] = names[keys.index(other)]
    note = "The names of left and right joints were exchanged, as stated with --swap-sides"
    skeleton = replace(clip.skeleton, names=tuple(out))
    notes = (*skeleton.source.notes, note)
    travel = skeleton.source.travel_joint
    moved = out[names.index(travel)] if travel in names else travel
    return clip.replaced(skeleton=skeleton.with_source(notes=notes, travel_joint=moved))


def _forwards(
    clip: Clip, anatomy: Anatomy, part: Clip, pos: np.ndarray, up: np.ndarray
) -> dict[str, np.ndarray]:
    """World directions `(S, 3)` in which the body may face, zero where a frame tells nothing."""
    feet, shins, thighs = (anatomy.of(k) for k in ("foot", "shin", "thigh"))
    out: dict[str, np.ndarray] = {}
    toes = [j for _, j in anatomy.toes]
    tips = dict(clip.skeleton.ends)
    way = np.zeros_like(up)
    quat = part.world()[1]
    for foot in feet:
        toe = next((t for t in toes if clip.skeleton.parents[t] == foot), None)
        if toe is not None:
            way += _across(pos[:, toe] - pos[:, foot], up)
        elif foot in tips:
            way += _across(_world(quat[:, foot], tips[foot]), up)
    if np.linalg.norm(way, axis=-1).max() > 0.01:
        out["feet"] = way
    bend = np.zeros_like(up)
    for thigh, shin, foot in zip(thighs, shins, feet, strict=True):
        line = _unit(pos[:, foot] - pos[:, thigh])
        knee = pos[:, shin] - pos[:, thigh]
        knee = knee - (knee * line).sum(-1, keepdims=True) * line
        # A knee tells the front only where it is bent by more than some 20 degrees.
        length = np.linalg.norm(pos[:, foot] - pos[:, shin], axis=-1, keepdims=True)
        bend += np.where(np.linalg.norm(knee, axis=-1, keepdims=True) > 0.09 * length, knee, 0.0)
    if np.linalg.norm(bend, axis=-1).max() > 0.0:
        out["knees"] = bend
    walk = np.gradient(pos[:, anatomy.of("pelvis")[0]], axis=0)
    walk[:, 2] = 0.0
    if np.linalg.norm(pos[-1, 0, :2] - pos[0, 0, :2]) > 1.0:
        out["travel"] = walk
    return out


def _world(quat: np.ndarray, tip: tuple[float, float, float]) -> np.ndarray:
    """`(S, 3)` m, a joint's own vector `tip` in the world."""
    turns = quat
    return quat_rotate(turns, np.broadcast_to(tip, (len(turns), 3)))


def _across(v: np.ndarray, up: np.ndarray) -> np.ndarray:
    return v - (v * up).sum(-1, keepdims=True) * up


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
