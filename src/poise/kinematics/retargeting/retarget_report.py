"""A report of a retargeting: its steps and its quality, in numbers and sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from poise.kinematics.retargeting.passage import Retargeter, Scale, hip_middle
from poise.kinematics.retargeting.plant import Foot
from poise.kinematics.retargeting.standing import ClipWorld, body_axes
from poise.metrics.tracking_errors import MM
from poise.motion.roles import SIDES, JointMap
from poise.motion.rotations import normalize
from poise.motion.vectors import norm

_BONES = (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))


@dataclass(frozen=True)
class RetargetReport:
    """How a motion came onto another skeleton.

    joints: what moves what. poses: how each skeleton's common pose was found, source first.
    scale: size of the target's steps over the source's. ground_m: height of the source's ground.
    bones: per limb bone ("left thigh") the mean and largest angle in degrees between its direction in
    the target and in the source. direction_deg, direction_max_deg: over all of them. trunk_deg: mean
    angle of the line from hips to shoulders.
    ends: per hand, foot and head the mean distance from where the source has it, seen from the hips, in
    percent of the height of the hips. end_percent: over all of them. hands_percent: mean and largest
    distance of wrists from the places that they were to keep (`HandPlaces`), in percent of the height of
    the hips; None where directions were kept.
    contact_s: seconds of foot contact, both feet together. slide_mm_s: mean horizontal speed of the feet
    in it, source (scaled to the target's size) and target. depth_mm: the deepest joint under the ground,
    mean over frames, source (scaled) and target; depth_max_mm likewise. seconds: time taken.
    """

    joints: JointMap
    poses: tuple[str, str]
    scale: float
    ground_m: float
    bones: tuple[tuple[str, float, float], ...]
    direction_deg: float
    direction_max_deg: float
    trunk_deg: float
    ends: tuple[tuple[str, float], ...]
    end_percent: float
    hands_percent: tuple[float, float] | None
    contact_s: float
    slide_mm_s: tuple[float, float]
    depth_mm: tuple[float, float]
    depth_max_mm: tuple[float, float]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """The report as plain numbers, lists and names, ready for JSON."""
        out = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "joints"}
        source, target = self.joints.source.skeleton.names, self.joints.target.skeleton.names
        out["bones"] = {name: {"mean_deg": a, "max_deg": b} for name, a, b in self.bones}
        out["ends"] = dict(self.ends)
        out["mapping"] = [
            {
                "role": r.role,
                "source": [source[j] for j in r.source],
                "target": target[r.target],
                "confidence": r.confidence,
                "evidence": r.evidence,
            }
            for r in self.joints.rows
        ]
        return out

    def sentences(self) -> list[str]:
        """The report in words, one line each."""
        joints = self.joints
        out = [
            f"The source: {joints.source.evidence}; {self.poses[0]}.",
            f"The target: {joints.target.evidence}; {self.poses[1]}.",
            f"Steps are scaled by {self.scale:.3f}, the ratio of the heights of the hips, over a ground "
            f"at {self.ground_m * 1000:+.0f} mm.",
            f"Bones of arms and legs point {self.direction_deg:.1f} degrees away from the source's on "
            f"average and {self.direction_max_deg:.0f} at most, the trunk {self.trunk_deg:.1f}.",
            f"Hands, feet and head are {self.end_percent:.1f} % of the hips' height from where the "
            "source has them, seen from the hips.",
        ]
        if self.hands_percent is not None:
            mean, most = self.hands_percent
            out.append(
                f"Wrists are {mean:.1f} % of the hips' height from the places that they keep, "
                f"{most:.0f} at most, in frames in which an arm is too short or would fold too far."
            )
        if self.contact_s > 0:
            out.append(
                f"Standing feet slide {self.slide_mm_s[1]:.0f} mm/s ({self.slide_mm_s[0]:.0f} in the "
                f"source) over {self.contact_s:.1f} s of contact."
            )
        else:
            out.append("No foot of the source stands, so none was held.")
        out.append(
            f"The deepest joint is {self.depth_max_mm[1]:.0f} mm under the ground "
            f"({self.depth_max_mm[0]:.0f} in the source)."
        )
        for names, side, what in (
            (joints.still(), "target", "follow what carries them"),
            (joints.unused(), "source", "move nothing"),
        ):
            if names:
                more = f" and {len(names) - 6} more" if len(names) > 6 else ""
                out.append(f"{', '.join(names[:6])}{more} of the {side} {what}.")
        return out


def measure(
    worlds: tuple[ClipWorld, ClipWorld],
    fps: float,
    passage: Retargeter,
    feet: tuple[Foot, ...],
    contacts: np.ndarray,
    kept: Mapping[str, np.ndarray],
    seconds: float,
) -> RetargetReport:
    """Measures what came of a retargeting; see `RetargetReport`. worlds: source and target. kept: places
    `(T, 3)` m of hands, by their names."""
    joints, scale, poses = passage.joints, passage.scale, (passage.here, passage.there)
    bones = _bones(joints, worlds[0].pos, worlds[1].pos)
    angles = np.concatenate([a for _, a in bones]) if bones else np.zeros(1)
    trunk = [body_axes(p.roles, w.pos)[1] for p, w in zip(poses, worlds, strict=True)]
    lean = [body_axes(p.roles, p.pos)[1] for p in poses]
    tilt = _angle(*trunk) - float(_angle(*lean))
    ends = _ends(passage, worlds[0].pos, worlds[1].pos)
    slide, held = _slide(feet, contacts, worlds, scale, fps)
    depths = [
        pose.depth(world, scale.ground) * factor * MM
        for pose, world, factor in zip(poses, worlds, (scale.factor, 1.0), strict=True)
    ]
    return RetargetReport(
        joints,
        (poses[0].evidence, poses[1].evidence),
        scale.factor,
        scale.ground,
        tuple((name, float(a.mean()), float(a.max())) for name, a in bones),
        float(angles.mean()),
        float(angles.max()),
        float(np.abs(tilt).mean()),
        ends,
        float(np.mean([e for _, e in ends])) if ends else 0.0,
        _kept(feet, kept, worlds[1].pos, poses[1].hip_height),
        held,
        slide,
        (float(depths[0].mean()), float(depths[1].mean())),
        (float(depths[0].max()), float(depths[1].max())),
        seconds,
    )


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle in degrees between directions `(..., 3)`, exact for small ones too."""
    a, b = normalize(a), normalize(b)
    return np.rad2deg(2.0 * np.arctan2(norm(a - b), norm(a + b)))


def _bones(joints: JointMap, source: np.ndarray, target: np.ndarray) -> list[tuple[str, np.ndarray]]:
    out = []
    for kind, after in _BONES:
        for side in SIDES:
            top, tip = joints.limb_pair(f"{side}_{kind}"), joints.limb_pair(f"{side}_{after}")
            if top is None or tip is None:
                continue
            lines = source[:, tip[0]] - source[:, top[0]], target[:, tip[1]] - target[:, top[1]]
            if min(float(norm(line).min()) for line in lines) < 1e-4:
                continue
            out.append((f"{side} {kind.replace('_', ' ')}", _angle(*lines)))
    return out


def _ends(passage: Retargeter, source: np.ndarray, target: np.ndarray) -> tuple[tuple[str, float], ...]:
    a, b = (
        (pos - hip_middle(passage.joints, pos, which)[:, None]) / pose.hip_height
        for which, (pos, pose) in enumerate(((source, passage.here), (target, passage.there)))
    )
    out = []
    for role in ("left_hand", "right_hand", "left_foot", "right_foot", "head"):
        pair = passage.joints.limb_pair(role)
        if pair is not None:
            apart = norm(a[:, pair[0]] - b[:, pair[1]]).mean()
            out.append((role.replace("_", " "), float(apart) * 100))
    return tuple(out)


def _kept(
    feet: tuple[Foot, ...], kept: Mapping[str, np.ndarray], pos: np.ndarray, tall: float
) -> tuple[float, float] | None:
    if not kept:
        return None
    far = [norm(pos[:, foot.target] - kept[foot.name]) for foot in feet if foot.name in kept]
    share = 100 * np.stack(far) / tall
    return float(share.mean()), float(share.max())


def _slide(
    feet: tuple[Foot, ...],
    contacts: np.ndarray,
    worlds: tuple[ClipWorld, ClipWorld],
    scale: Scale,
    fps: float,
) -> tuple[tuple[float, float], float]:
    """Mean horizontal speed (mm/s) of the feet between frames of contact, source and target; seconds."""
    total, steps = [0.0, 0.0], 0
    for k, foot in enumerate(feet):
        if not foot.name.endswith("foot"):
            continue
        both = contacts[1:, k] & contacts[:-1, k]
        steps += int(both.sum())
        for which, factor in ((0, scale.factor), (1, 1.0)):
            point = foot.points(*worlds[which], target=bool(which))[:, :2]
            total[which] += float(norm(np.diff(point, axis=0))[both].sum()) * factor
    seconds = steps / fps
    rate = [MM * t / seconds if steps else 0.0 for t in total]
    return (rate[0], rate[1]), seconds
