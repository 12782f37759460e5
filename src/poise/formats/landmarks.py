"""From labelled keypoints to complete tracks of the places of a body."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from poise.errors import PoiseError
from poise.formats.markers import NEEDED, SIDES, find_places, known_labels, marker_places, unknown_labels
from poise.formats.point_noise import (
    RemovedTremble,
    drop_spikes,
    fill,
    longest_stretch,
    smooth,
    spike_note,
    still,
)
from poise.formats.text import listed
from poise.motion.keypoints import Keypoints
from poise.motion.smoothing import NOTHING_MM, filled, only_noise

# What a place is filled relative to, so that a hidden wrist travels with its elbow.
_CARRIER = {"knee": "hip", "ankle": "knee", "heel": "ankle", "toe": "ankle", "toe_tip": "ankle"}
_CARRIER |= {"elbow": "shoulder", "wrist": "elbow", "hand": "wrist"}
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Landmarks:
    """Complete tracks of the places of one body; m, Z up.

    tracks: place -> `(T, 3)`, no NaN.
    first: the frame of the recording that is frame 0 here. notes: one sentence per repair.
    tremble: what was taken off, None without any.
    """

    tracks: dict[str, np.ndarray]
    first: int
    notes: tuple[str, ...]
    tremble: RemovedTremble | None = None


def places_of(points: Keypoints) -> tuple[dict[str, np.ndarray], list[str]]:
    """Tracks `(T, 3)` of all places that labels or markers give (NaN where missing), and notes.

    Raises:
        PoiseError: a needed place has no keypoint, or a keypoint that is never seen.
    """
    # A label that is never seen still says what the others mean, and tells no place.
    there = [not np.isnan(points.positions[:, k, 0]).all() for k in range(len(points.names))]
    found = {p: [k for k in ks if there[k]] for p, ks in find_places(points.names).items()}
    tracks = {place: points.positions[:, ks].mean(1) for place, ks in found.items() if ks}
    seen = [name for name, known in zip(points.names, there, strict=True) if known]
    marked, notes = marker_places(seen, points.positions[:, np.array(there)], tracks)
    # Joints that are named outright win over estimates from surface markers.
    tracks = {**marked, **tracks}
    unseen = [name for name in points.names if name not in seen]
    lost = [place for place in NEEDED if place not in tracks]
    lost += [place for place in NEEDED if place in tracks and np.isnan(tracks[place][:, 0]).all()]
    if lost:
        raise _lacking(points, lost, unseen)
    if unseen:
        notes.append(f"Missing in every frame and left out: {listed(unseen, 6)}")
    return tracks, notes


def _lacking(points: Keypoints, lost: list[str], unseen: list[str]) -> PoiseError:
    """Which places have no keypoint, what the file has, and which label may have been meant."""
    places = listed((place.replace("_", " ") for place in lost), 12)
    named = find_places(points.names)
    marked = marker_places(points.names, np.zeros((2, len(points.names), 3)), {})[0]
    if unseen and {*named, *marked}.issuperset(lost):
        direct = {points.names[k] for place in lost for k in named.get(place, ())}
        mine = [name for name in unseen if name in direct or not direct]
        one, quoted = len(mine) == 1, listed((f"'{name}'" for name in mine), 6)
        return PoiseError(
            f"{'keypoint' if one else 'keypoints'} {quoted} {'is' if one else 'are'} missing in every "
            f"frame, and nothing else shows the {places}",
            points.source.path or points.name,
            f"Track {'that keypoint' if one else 'those keypoints'} again, or fill "
            f"{'it' if one else 'them'} in where the file was made: the body needs both hips, knees, "
            "ankles, shoulders, elbows and wrists",
            code="keypoints-unseen",
        )
    side, part = lost[0].split("_")
    wanted = (
        f"{side[0].upper()}{part.capitalize()}",
        lost[0],
        f"{side.capitalize()}{part.capitalize()}",
    )
    guess = next(
        (g for w in wanted for g in get_close_matches(w, unknown_labels(points.names), 1)), None
    )
    hint = f"Did you mean '{guess}'? " if guess else ""
    hint += f"The keypoints are {listed(points.names, 12)}; labels like "
    hint += f"{listed(known_labels(), 6)} or the joint names of BVH, SMPL and COCO are understood"
    return PoiseError(
        f"no keypoint is the {places}", points.source.path or points.name, hint, code="keypoint-missing"
    )


def complete(points: Keypoints, max_gap_s: float, spikes: bool, smooth_hz: float | None) -> Landmarks:
    """All places of the body without spikes, gaps and noise (`still`); keypoints that are to stay as
    their file has them (`Source.raw`) keep their spikes and their noise.

    Gaps are interpolated in the place of the joint above (wrist from elbow). The recording is cut to its
    longest stretch in which no needed place is missing for longer than `max_gap_s`. smooth_hz: the
    cut-off of a low-pass in place of what the noise asks for.
    """
    notes: list[str] = []
    if spikes and not points.source.raw:
        cleaned, jumps = drop_spikes(points.positions, points.fps)
        notes += spike_note(points.names, jumps)
        points = points.replaced(positions=cleaned)
    tracks, told = places_of(points)
    notes += told
    unknown = unknown_labels(points.names)
    if unknown:
        notes.append(
            f"{len(unknown)} of {len(points.names)} labels tell no place of a body and were left out "
            f"({listed(unknown, 5)})"
        )
    tracks = _without_rare(tracks, notes)
    missing = np.stack([np.isnan(tracks[place][:, 0]) for place in NEEDED], -1)
    start, stop = longest_stretch(missing, max(0, round(max_gap_s * points.fps)))
    if stop - start < 2:
        worst = NEEDED[int(missing.sum(0).argmax())].replace("_", " ")
        raise PoiseError(
            f"no two frames in a row have all needed keypoints (the {worst} is missing most often)",
            points.source.path or points.name,
            code="keypoints-unseen",
        )
    if stop - start < points.frames:
        notes.append(
            f"Only frames {start} to {stop - 1} of {points.frames} were kept: outside, "
            f"{_lost(missing, start, stop)} missing for longer than {max_gap_s:g} s or up to an end"
        )
    tracks = {place: track[start:stop] for place, track in tracks.items()}
    gaps = [(int(np.isnan(track[:, 0]).sum()), place) for place, track in tracks.items()]
    gaps = [gap for gap in gaps if gap[0]]
    if gaps:
        worst = listed((f"{p.replace('_', ' ')} {n}" for n, p in sorted(gaps, reverse=True)), 6)
        notes.append(f"Missing samples were interpolated: {worst} (frames)")
    tracks = _filled(tracks, points.fps)
    found: RemovedTremble | None = None
    if smooth_hz is None and not points.source.raw:
        tracks, found = still(tracks, points.fps)
    if found is not None:
        if found.size_mm > NOTHING_MM:
            frames = slice(start, start + len(tracks[NEEDED[0]]))
            size = f"{found.size_mm / 1e3:.2g} m"
            raise only_noise(points.source.path or points.name, frames, size)
        notes.append(
            f"The keypoints tremble by {found.size_mm:.0f} mm {found.how}: the tremble is taken off "
            "(--raw keeps it)"
        )
    if smooth_hz is not None:
        tracks = {place: smooth(track, points.fps, smooth_hz) for place, track in tracks.items()}
        notes.append(
            f"The keypoints were smoothed by a zero-phase Gaussian low-pass at {smooth_hz:g} Hz"
        )
    return Landmarks(tracks, start, tuple(notes), found)


def _lost(missing: np.ndarray, start: int, stop: int) -> str:
    outside = missing.copy()
    outside[start:stop] = False
    places = [NEEDED[k].replace("_", " ") for k in np.flatnonzero(outside.any(0))]
    return f"the {listed(places, 4)} {'is' if len(places) == 1 else 'are'}"


def _without_rare(tracks: dict[str, np.ndarray], notes: list[str]) -> dict[str, np.ndarray]:
    """Drops places that the body can do without and that are seen in less than half of the frames."""
    rare = [
        place
        for place, track in tracks.items()
        if place not in NEEDED and (~np.isnan(track[:, 0])).mean() < _LEAST_SHARE
    ]
    if rare:
        names = listed((place.replace("_", " ") for place in rare), 6)
        notes.append(f"Seen in less than half of the frames and left out: {names}")
    return {place: track for place, track in tracks.items() if place not in rare}


def _filled(tracks: dict[str, np.ndarray], fps: float) -> dict[str, np.ndarray]:
    """All gaps interpolated: hips in the world, everything else as seen from its carrier."""
    out = {f"{side}_hip": _curved(tracks[f"{side}_hip"], fps) for side in SIDES}
    hips = (out["left_hip"] + out["right_hip"]) / 2
    out |= {f"{side}_shoulder": hips + _curved(tracks[f"{side}_shoulder"] - hips, fps) for side in SIDES}
    chest = (out["left_shoulder"] + out["right_shoulder"]) / 2
    for part, carrier in _CARRIER.items():
        for side in SIDES:
            place, above = f"{side}_{part}", f"{side}_{carrier}"
            if place in tracks:
                out[place] = out[above] + _curved(tracks[place] - out[above], fps)
    for place, track in tracks.items():
        if place not in out:
            base = hips if place == "pelvis" or place.startswith("spine") else chest
            out[place] = base + _curved(track - base, fps)
    return out


def _curved(values: np.ndarray, fps: float) -> np.ndarray:
    """Values `(T, C)` with gaps on the smoothest curve; at the ends they hold."""
    known = ~np.asarray(np.isnan(values).any(-1))
    at = np.flatnonzero(known)
    if len(at) == len(known) or len(at) < 4:
        return fill(values)
    first, last = int(at[0]), int(at[-1])
    out = fill(values)
    inside = slice(first, last + 1)
    out[inside] = filled(out[inside], known[inside], fps)
    return out
