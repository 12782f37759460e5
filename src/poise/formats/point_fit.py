"""Keypoints become a clip: a skeleton is measured on them, then posed in every frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from poise.errors import PoiseError
from poise.formats.landmarks import complete, places_of
from poise.formats.markers import SIDES
from poise.formats.point_skeleton import TITLE, Rest, Solver, hold_lengths, measure, trunk_tracks
from poise.formats.text import listed
from poise.motion.clip import Clip
from poise.motion.keypoints import Keypoints
from poise.motion.skeleton import Skeleton, triple
from poise.motion.vectors import lower_median, norm
from poise.settings import Checked, NotNegative, Positive

_LIMBS = {"UpLeg": "hip", "Leg": "knee", "Foot": "ankle", "ToeBase": "toe"}
_LIMBS |= {"Shoulder": "collar", "Arm": "shoulder", "ForeArm": "elbow", "Hand": "wrist"}
JOINT_PLACES = {f"{TITLE[s]}{joint}": f"{s}_{place}" for joint, place in _LIMBS.items() for s in SIDES}
JOINT_PLACES |= {"Hips": "pelvis", "Neck": "neck", "Head": "head"}
"""Joint of the fitted skeleton -> place of the body that it should lie on."""


@dataclass(frozen=True)
class FitConfig(Checked):
    """How keypoints become a clip.

    max_gap_s: the longest gap (s) of a needed keypoint that is interpolated; the recording is cut to its
        longest stretch without longer ones.
    drop_spikes: whether samples that jump out of their path and back are taken as missing.
    smooth_hz: cut-off of a zero-phase low-pass on the keypoints; None takes off what noise they have
        (`points.tremble`), and nothing where they have none.
    """

    max_gap_s: NotNegative = 0.5
    drop_spikes: bool = True
    smooth_hz: Positive | None = None


def fit_clip(points: Keypoints, config: FitConfig | None = None) -> Clip:
    """The clip of a skeleton that follows keypoints; metres, Z up.

    Bones have the median length over all frames, left and right alike. The pelvis and the chest are
    turned by a closed-form fit of their points, a limb points from joint to joint, its twist comes from
    the plane in which its knee or elbow bends, and feet and head turn with heel, toes, ears and nose
    where they are seen. Everything that had to be assumed stands in `clip.skeleton.source.notes`.

    Raises:
        PoiseError: a hip, knee, ankle, shoulder, elbow or wrist that no keypoint shows.
    """
    config = config or FitConfig()
    marks = complete(points, config.max_gap_s, config.drop_spikes, config.smooth_hz)
    notes = list(marks.notes)
    tracks, spine = trunk_tracks(dict(marks.tracks), notes)
    if not _span(tracks) > 1e-6:
        raise PoiseError(
            "all keypoints lie in one place",
            points.source.path or points.name,
            code="points-in-one-place",
        )
    rest = measure(tracks, spine, notes)
    if bad := next((n for n, offset in rest.offsets.items() if not np.isfinite(offset).all()), None):
        what = f"its keypoints give the bone to '{bad}' no length that is a number"
        raise PoiseError(what, points.source.path or points.name, code="zero-length-bone")
    tracks = hold_lengths(tracks, bones_of(rest))
    root_pos, rot = Solver(rest, tracks, points.fps).run()
    names = tuple(rest.parents)
    skeleton = Skeleton(
        names,
        tuple(-1 if up is None else names.index(up) for up in rest.parents.values()),
        np.stack([rest.offsets[n] for n in names]),
        tuple((names.index(n), triple(tip)) for n, tip in rest.tips.items()),
        points.source,
    )
    clip = Clip(skeleton, root_pos, rot, points.fps, points.name)
    stop = marks.first + clip.frames
    note = _misfit_note(fit_distances(_cut(points, marks.first, stop), clip))
    all_notes = (*points.source.notes, *notes, note)
    mended = points.source.mended
    if marks.tremble is not None:
        found = marks.tremble
        hz = "" if found.hz is None else f"{found.hz:.6g}"
        mended += (("tremble", hz, 0, clip.frames - 1, found.size_mm / 1e3),)
    return clip.replaced(skeleton=skeleton.with_source(notes=all_notes, mended=mended))


def fit_distances(points: Keypoints, clip: Clip) -> dict[str, np.ndarray]:
    """Joint -> `(T,)` m from the fitted joint to the keypoint it follows, NaN where missing."""
    tracks, _ = places_of(points)
    if points.frames != clip.frames:
        raise PoiseError(
            f"{points.frames} frames of keypoints and {clip.frames} of the clip",
            clip.name,
            code="length-differs",
        )
    pos = clip.positions()
    return {
        joint: np.linalg.norm(pos[:, clip.skeleton.index(joint)] - tracks[place], axis=-1)
        for joint, place in JOINT_PLACES.items()
        if place in tracks and joint in clip.skeleton.names
    }


def _cut(points: Keypoints, start: int, stop: int) -> Keypoints:
    part = None if points.confidence is None else points.confidence[start:stop]
    return replace(points, positions=points.positions[start:stop], confidence=part)


def _span(tracks: dict[str, np.ndarray]) -> float:
    """How far the body reaches (m) in half of the frames at least."""
    every = np.stack([tracks["left_hip"], tracks["left_ankle"], tracks["right_shoulder"]])
    return float(lower_median(norm(every - every[:1]).max(0)))


def bones_of(rest: Rest) -> list[tuple[str, str, float]]:
    """The bones that keypoints show: the hips' distance, thighs, shins, upper arms, forearms."""
    hips = np.linalg.norm(rest.offsets["LeftUpLeg"] - rest.offsets["RightUpLeg"])
    bones = [("left_hip", "right_hip", float(hips))]
    for side in SIDES:
        for upper, lower in (("UpLeg", "Leg"), ("Leg", "Foot"), ("Arm", "ForeArm"), ("ForeArm", "Hand")):
            length = float(np.linalg.norm(rest.offsets[f"{TITLE[side]}{lower}"]))
            bones.append((f"{side}_{_LIMBS[upper]}", f"{side}_{_LIMBS[lower]}", length))
    return bones


def _misfit_note(distances: dict[str, np.ndarray]) -> str:
    means = {joint: float(np.nanmean(d)) * 1e3 for joint, d in distances.items() if np.isfinite(d).any()}
    worst = sorted(means, key=lambda j: -means[j])[:3]
    return (
        f"A skeleton of rigid bones was fitted: its joints lie "
        f"{np.mean(list(means.values())):.1f} mm from the keypoints on average (most: "
        f"{listed(f'{j} {means[j]:.0f} mm' for j in worst)})"
    )
