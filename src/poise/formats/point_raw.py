"""Keypoints as a file holds them, and their way into metres and Z up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.guess import (
    Guess,
    clear_axis,
    guess_unit,
    guess_up,
    later_frames,
    lean,
    stated_unit,
    supports,
)
from poise.formats.landmarks import places_of
from poise.formats.markers import NEEDED, SIDES, middle_label
from poise.formats.one_person import person_of
from poise.formats.point_fit import FitConfig, fit_clip
from poise.formats.point_noise import runs
from poise.formats.raw import ReadOptions, evidence, vectors_to_z_up
from poise.formats.refused import FLAT_HINT
from poise.formats.text import MAX_JOINTS, MAX_NAME, MAX_VALUE, listed, shown
from poise.motion.clip import Clip, check_poses, check_rate
from poise.motion.clip_info import body_height, sampled
from poise.motion.keypoints import Keypoints
from poise.motion.skeleton import Source

#: A point may be at the origin if the frame before or after finds it nearer than this share of the body.
_NEAR = 0.1


def without_zeros(names: Sequence[str], positions: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Positions `(T, K, 3)` with NaN where exact zeros stand for a missing point, and a note about them.

    A point that comes from near the origin or goes there is one. So is the middle of a body (pelvis,
    neck, ...) that is always there while the others are around it: the origin of points that are told
    relative to it.
    """
    zero = (positions == 0.0).all(-1)
    if not zero.any():
        return positions, []
    known = np.where(zero[..., None], np.nan, positions)
    seen = known[~np.isnan(known).any(-1).all(-1)]
    if not len(seen):
        return positions, []
    size = float(np.median(np.linalg.norm(_extent(seen), axis=-1)))
    missing = zero.copy()
    for k in map(int, np.flatnonzero(zero.any(0))):
        if zero[:, k].all():
            missing[:, k] = not (middle_label(names[k]) and _around_origin(seen, size))
            continue
        far = np.linalg.norm(np.where(zero[:, k, None], np.nan, positions[:, k]), axis=-1)
        for start, stop in runs(zero[:, k]):
            beside = [far[i] for i in (start - 1, stop) if 0 <= i < len(far)]
            missing[start:stop, k] = not any(d < _NEAR * size for d in beside)
    if not missing.any():
        return positions, []
    counts = missing.sum(0)
    told = listed(
        (f"{names[k]} {counts[k]}" for k in np.argsort(-counts, kind="stable") if counts[k]), 6
    )
    note = (
        f"{int(counts.sum())} of {missing.size} points are written as 0 0 0 where they are missing: "
        f"they were not taken as places ({told})"
    )
    return np.where(missing[..., None], np.nan, positions), [note]


def _extent(points: np.ndarray) -> np.ndarray:
    """`(T, 3)` how far the known points `(T, K, 3)` reach along each axis; each frame has one."""
    return np.nanmax(points, axis=1) - np.nanmin(points, axis=1)


def _around_origin(points: np.ndarray, size: float) -> bool:
    """Whether the known points `(T, K, 3)` lie around the origin in nearly all frames."""
    low, high = np.nanmin(points, axis=1), np.nanmax(points, axis=1)
    slack = _NEAR * size
    return bool(((low < slack) & (high > -slack)).all(-1).mean() > 0.95)


UNITS_M = {"m": 1.0, "meters": 1.0, "metres": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
UNITS_M |= {"ft": 0.3048, "dm": 0.1}
"""Metres in a unit, as tables of points call it."""


@dataclass(frozen=True)
class RawPoints:
    """Named points in their file's own unit and axes.

    positions: `(T, K, 3)`, NaN where missing. unit_m, up_axis: what the file states, None where it
    states nothing. confidence: `(T, K)` or None. unit_note: why `unit_m`, where no file states it.
    rates: as in `Source.rates`.
    """

    format: str
    path: Path
    names: tuple[str, ...]
    positions: np.ndarray
    fps: float
    unit_m: float | None = None
    up_axis: str | None = None
    confidence: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    unit_note: str = ""
    rates: tuple[float, ...] = ()


# The places with the bones that make up a body's height, as the guesses know their names.
_TREE = {"hips": None, "neck": "hips", "head": "neck"}
_TREE |= {f"{s} {part}": above for s in SIDES for part, above in (("hip", "hips"),)}
_TREE |= {f"{s} knee": f"{s} hip" for s in SIDES} | {f"{s} ankle": f"{s} knee" for s in SIDES}


def assemble_points(raw: RawPoints, options: ReadOptions) -> Keypoints:
    """Keypoints in metres, Z up, with every guess in the source's notes.

    Unit and vertical are guessed as for skeletons (`guess.py`), from the places of a body that the
    labels name. Points that stand on their head (Y down, as cameras have it) are turned over, even where
    the file states Y up.

    Raises:
        PoiseError: too few frames, flat (2D) points, a person of no human size.
    """
    raw = _of_one_person(raw, options)
    _check(raw)
    check_rate(float(options.fps or raw.fps), raw.path)
    source = Source(format=raw.format, path=str(raw.path))
    probe = Keypoints(raw.names, raw.positions, raw.fps, raw.path.stem, raw.confidence, source)
    body = _body(probe)
    notes = list(raw.notes)
    up, unit = _up(body, options, raw), _unit(body, options, raw)
    notes += [guess.note for guess in (up, unit) if guess.note]
    axis, scale = str(up.value), float(unit.value)
    positions = vectors_to_z_up(probe.positions, axis) * scale
    stated = f"The file has {raw.fps:.6g} frames per second"
    rate = next((n for n in raw.notes if "frame rate" in n), stated)
    return Keypoints(
        raw.names,
        positions,
        float(options.fps or raw.fps),
        raw.path.stem,
        raw.confidence,
        Source(
            format=raw.format, path=str(raw.path), unit_m=scale, up_axis=axis, notes=tuple(notes),
            frame_time=1.0 / raw.fps, evidence=evidence(options, up, unit, rate),
            rates=() if options.fps is not None else raw.rates, raw=options.raw,
        ),
    )  # fmt: skip


def _of_one_person(raw: RawPoints, options: ReadOptions) -> RawPoints:
    """The points of one person, without those that are 0 0 0 since they were not seen."""
    keep, names, people = person_of(raw.names, options.take, raw.path)
    positions, zeros = without_zeros(names, raw.positions[:, keep])
    scores = None if raw.confidence is None else raw.confidence[:, keep]
    notes = (*raw.notes, *people, *zeros)
    return replace(raw, names=names, positions=positions, confidence=scores, notes=notes)


def as_clip(points: Callable[..., RawPoints]) -> Callable[..., Clip]:
    """The reader of clips that a reader of points makes: a skeleton follows them, see `fit_clip`.

    points: takes a path and `ReadOptions`, or named arrays before them.
    """

    def read(*given: Any) -> Clip:
        options: ReadOptions = given[-1]
        raw = assemble_points(points(*given), options)
        return fit_clip(raw, FitConfig(smooth_hz=options.smooth_hz))

    return read


def _check(raw: RawPoints) -> None:
    frames = len(raw.positions)
    if len(raw.names) > MAX_JOINTS:
        raise PoiseError(
            f"it has {len(raw.names)} keypoints, more than the {MAX_JOINTS} allowed",
            raw.path,
            code="too-many-joints",
        )
    longest = max(raw.names, key=len, default="")
    if len(longest) > MAX_NAME:
        raise PoiseError(
            f"the keypoint {shown(longest)} has a name of {len(longest)} characters",
            raw.path,
            code="over-limit",
        )
    if frames < 2:
        raise PoiseError(
            f"it has {frames} frame{'' if frames == 1 else 's'}; motion needs at least 2",
            raw.path,
            code="clip-too-short",
        )
    check_poses(frames, len(raw.names), raw.path)
    known = raw.positions[~np.isnan(raw.positions).any(-1)]
    if not len(known):
        raise PoiseError("every keypoint is missing in every frame", raw.path, code="keypoints-unseen")
    if np.abs(known).max() > MAX_VALUE:
        raise PoiseError(
            f"it holds coordinates above {MAX_VALUE:g}, no place of a person", raw.path, code="too-far"
        )
    flat = [c for c, width in zip("XYZ", np.ptp(known, axis=0), strict=True) if width == 0]
    if len(flat) == 3:
        raise PoiseError("all keypoints lie in one place", raw.path, code="points-in-one-place")
    if flat:
        raise PoiseError(
            f"the keypoints are flat: {' and '.join(flat)} never changes, as in the 2D of a camera",
            raw.path,
            FLAT_HINT,
            code="flat-keypoints",
        )


@dataclass(frozen=True)
class _SampledBody:
    """Places of a body in sampled frames `(S, P, 3)`: what tells its size, and all that it may stand on.

    later: `every`, `LATER_S` later.
    """

    names: list[str]
    parents: list[int]
    pos: np.ndarray
    every_name: list[str]
    every: np.ndarray
    later: np.ndarray


def _body(points: Keypoints) -> _SampledBody:
    tracks, _ = places_of(points)
    seen = np.asarray(~np.isnan(np.stack([tracks[p][:, 0] for p in NEEDED], -1)).any(-1))
    frames = np.flatnonzero(seen)
    if not len(frames):
        raise PoiseError(
            "in no frame are all hips, knees, ankles, shoulders, elbows and wrists seen",
            points.source.path,
            code="keypoints-unseen",
        )
    after = later_frames(frames, points.fps, len(seen))
    # Frames with a later one tell what stands still; without any, each is its own later one.
    both = seen[after]
    frames, after = (frames[both], after[both]) if both.any() else (frames, frames)
    at = sampled(len(frames))
    tracks = {p.replace("_", " "): t for p, t in tracks.items()}
    hips = (tracks["left hip"] + tracks["right hip"]) / 2
    neck = (tracks["left shoulder"] + tracks["right shoulder"]) / 2
    tracks = {**tracks, "hips": hips, "neck": neck}
    places = {n: t[frames[at]] for n, t in tracks.items() if not np.isnan(t[frames[at]]).any()}
    names = [n for n in _TREE if n in places]
    parents = [-1 if (up := _TREE[n]) is None else names.index(up) for n in names]
    known = [n for n in places if not np.isnan(tracks[n][after[at]]).any()]
    return _SampledBody(
        names,
        parents,
        np.stack([places[n] for n in names], 1),
        known,
        np.stack([places[n] for n in known], 1),
        np.stack([tracks[n][after[at]] for n in known], 1),
    )


def _offsets(parents: list[int], pos: np.ndarray) -> np.ndarray:
    """`(P, 3)` with the median length of each bone."""
    out = np.zeros((len(parents), 3))
    for j, parent in enumerate(parents):
        if parent >= 0:
            out[j, 0] = np.median(np.linalg.norm(pos[:, j] - pos[:, parent], axis=-1))
    return out


def _unit(body: _SampledBody, options: ReadOptions, raw: RawPoints) -> Guess:
    height, how = body_height(body.names, body.parents, _offsets(body.parents, body.pos), body.pos)
    if not height > 0:
        raise PoiseError("all keypoints lie in one place", raw.path, code="points-in-one-place")
    # A stated unit that makes a giant or a doll is a mistake, the file's too; the sentence tells.
    stated = raw.unit_m if options.unit_m is None else options.unit_m
    if stated is not None:
        note = raw.unit_note if options.unit_m is None else ""
        return Guess(stated_unit(height, stated, raw.path).value, note)
    return guess_unit(height, how, None, raw.path)


def _up(body: _SampledBody, options: ReadOptions, raw: RawPoints) -> Guess:
    if options.up_axis is not None:
        return Guess(options.up_axis.upper())
    if raw.up_axis is None:
        return guess_up(body.every_name, body.every, None, body.later)
    axis = raw.up_axis.upper()
    over = axis[1:] if axis[0] == "-" else f"-{axis}"
    if clear_axis(lean(body.every_name, body.every)) != over:
        return Guess(axis)
    borne = supports(body.every_name, body.every, body.later)
    if borne[axis].cost < borne[over].cost:
        # A handstand.
        return Guess(axis)
    told = (
        f"The heads lie below the feet along {axis}, which the file states: the points were turned over"
    )
    return Guess(over, f"{told} (override with --up {axis})")
