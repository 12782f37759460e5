"""Motion as a file holds it, and its way into metres and Z up (and back)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.guess import (
    UPS,
    Guess,
    guess_unit,
    guess_up,
    inserted_rest_frames,
    later_frames,
    stated_unit,
    teleports,
)
from poise.formats.root_joint import beside_note
from poise.formats.text import MAX_JOINTS, shown
from poise.motion.clip import Clip, check_frames, check_poses, check_rate
from poise.motion.clip_info import body_height, sampled
from poise.motion.roles import SIDES, find_roles
from poise.motion.rotations import forward_kinematics, normalize, unwrap_quats
from poise.motion.skeleton import Channel, Skeleton, Source, rest_positions, triple


@dataclass(frozen=True)
class ReadOptions:
    """What the caller states instead of leaving it to a guess; None where it is not stated.

    rest: a file that holds a skeleton and no animation is read as it rests. raw: as in `Source`.
    """

    skeleton: Path | None = None
    fps: float | None = None
    unit_m: float | None = None
    up_axis: str | None = None
    allow_pickle: bool = False
    smooth_hz: float | None = None
    take: str | None = None
    rest: bool = False
    raw: bool = False


UNSTATED = ReadOptions()

#: A joint of a layout: its name, its parent and its offset, m; "*" in names stands for a side.
Row = tuple[str, str | None, tuple[float, float, float]]


def sided(rows: Iterable[Row], sides: Sequence[tuple[str, float]], axis: int = 0) -> list[Row]:
    """The rows, those of a side once for each of `sides`: its name, and the sign of its `axis`."""
    out: list[Row] = []
    for name, parent, offset in rows:
        for side, sign in sides if "*" in name else (("", 1.0),):
            x, y, z = (sign * v if k == axis else v for k, v in enumerate(offset))
            out.append((name.replace("*", side), parent and parent.replace("*", side), (x, y, z)))
    return out


def tree_of(rows: Sequence[Row]) -> tuple[tuple[str, ...], tuple[int, ...], np.ndarray]:
    """Names, parents and offsets `(J, 3)` of joints."""
    names = tuple(name for name, *_ in rows)
    parents = tuple(-1 if parent is None else names.index(parent) for _, parent, _ in rows)
    return names, parents, np.array([offset for *_, offset in rows])


@dataclass(frozen=True)
class RawMotion:
    """One motion in its file's own unit and axes.

    offsets `(J, 3)`, ends, root_pos `(T, 3)`: file units. rot: `(T, J, 4)` wxyz, local.
    unit_m, up_axis: what the format itself states, None where it states nothing.
    unit_hint: a unit the file suggests, checked with the person's height.
    strays: `(joint, largest distance)` of position channels that did not stay constant; beside: the
        same of joints that do not hang on `travel_joint`.
    whole: frame 0 belongs to the motion for certain, so no rest pose is sought there.
    mended, rates: as in `Source`.
    """

    format: str
    path: Path
    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    ends: tuple[tuple[int, tuple[float, float, float]], ...]
    root_pos: np.ndarray
    rot: np.ndarray
    fps: float
    channels: tuple[Channel, ...]
    frame_time: float | None = None
    unit_m: float | None = None
    unit_hint: float | None = None
    up_axis: str | None = None
    travel_joint: str | None = None
    cyclic: bool = False
    notes: tuple[str, ...] = ()
    strays: tuple[tuple[str, float], ...] = ()
    beside: tuple[tuple[str, float], ...] = ()
    mended: tuple[tuple[str, str, int, int, float], ...] = ()
    extra: tuple[tuple[str, str], ...] = ()
    whole: bool = False
    rates: tuple[float, ...] = ()


# For each vertical the turn that carries it to Z: the file's axis and its sign behind each of ours.
# Y and the downward ones are turned about X, so that X stays.
_TURNS = {
    "Y": ((0, 1), (2, -1), (1, 1)),
    "Z": ((0, 1), (1, 1), (2, 1)),
    "X": ((1, 1), (2, 1), (0, 1)),
    "-Y": ((0, 1), (2, 1), (1, -1)),
    "-Z": ((0, 1), (1, -1), (2, -1)),
    "-X": ((1, 1), (2, -1), (0, -1)),
}


def vectors_to_z_up(v: np.ndarray, up_axis: str) -> np.ndarray:
    """Vectors `(..., 3)` of a file with vertical `up_axis` (one of `UPS`) in Z-up axes; a pure turn."""
    if up_axis == "Z":
        return v
    return np.stack([v[..., axis] if sign > 0 else -v[..., axis] for axis, sign in _TURNS[up_axis]], -1)


def vectors_from_z_up(v: np.ndarray, up_axis: str) -> np.ndarray:
    """The inverse of `vectors_to_z_up`."""
    if up_axis == "Z":
        return v
    back = {axis: (k, sign) for k, (axis, sign) in enumerate(_TURNS[up_axis])}
    return np.stack(
        [v[..., back[c][0]] if back[c][1] > 0 else -v[..., back[c][0]] for c in range(3)], -1
    )


def quats_to_z_up(q: np.ndarray, up_axis: str) -> np.ndarray:
    """Rotations `(..., 4)` conjugated by the same turn: C q C^-1 turns the vector part."""
    return np.concatenate((q[..., :1], vectors_to_z_up(q[..., 1:], up_axis)), -1)


def quats_from_z_up(q: np.ndarray, up_axis: str) -> np.ndarray:
    """The inverse of `quats_to_z_up`."""
    return np.concatenate((q[..., :1], vectors_from_z_up(q[..., 1:], up_axis)), -1)


def check_options(options: ReadOptions) -> None:
    """Refuses overrides that make no sense."""
    stated = (("unit", options.unit_m), ("smooth", options.smooth_hz))
    if options.fps is not None:
        check_rate(options.fps, "--fps")
    for name, value in stated:
        if value is not None and not (np.isfinite(value) and value > 0):
            raise PoiseError(f"--{name} must be above 0, got {value}", code="out-of-range")
    if options.up_axis is not None and options.up_axis.upper() not in UPS:
        raise PoiseError(
            f"--up must be one of {', '.join(UPS)}, got '{options.up_axis}'", code="unknown-axis"
        )


def assemble(raw: RawMotion, options: ReadOptions) -> Clip:
    """The clip in metres, Z up, with every guess and repair in its source's notes."""
    _check(raw)
    check_rate(float(options.fps or raw.fps), raw.path)
    check_poses(len(raw.rot), len(raw.names), raw.path)
    notes = list(raw.notes)
    whole = len(raw.rot)
    raw = _drop_rest_frames(raw, notes)
    dropped = whole - len(raw.rot)
    mended = [*raw.mended, *((("rest frame", "", 0, dropped - 1, float(dropped)),) if dropped else ())]
    rot = _unwrapped(raw.rot)
    up, unit = _up_and_unit(raw, rot, options)
    notes += [guess.note for guess in (up, unit) if guess.note]
    scale = float(unit.value)  # type: ignore[arg-type]
    axis = str(up.value)
    for name, stray in raw.strays:
        notes.append(
            f"Joint '{name}' moves against its parent by up to {stray * scale * 1e3:.1f} mm; its bone "
            "is kept rigid at the median"
        )
        mended.append(("bone drift", name, 0, -1, stray * scale))
    if raw.beside:
        notes.append(beside_note(str(raw.travel_joint), raw.beside, scale))
    fps = float(options.fps or raw.fps)
    root_pos = vectors_to_z_up(raw.root_pos, axis) * scale
    notes += teleports(root_pos, fps)
    skeleton = Skeleton(
        raw.names,
        raw.parents,
        vectors_to_z_up(raw.offsets, axis) * scale,
        tuple((j, triple(vectors_to_z_up(np.array(tip), axis) * scale)) for j, tip in raw.ends),
        Source(
            format=raw.format,
            path=str(raw.path),
            unit_m=scale,
            up_axis=axis,
            channels=raw.channels,
            frame_time=raw.frame_time,
            travel_joint=raw.travel_joint,
            notes=tuple(notes),
            evidence=evidence(options, up, unit, _rate(raw)),
            mended=tuple(mended),
            extra=raw.extra,
            rates=() if options.fps is not None else raw.rates,
        ),
    )
    for part in _parts(rot):
        part[...] = quats_to_z_up(part, axis)
    rot.flags.writeable = False
    return Clip(skeleton, root_pos, rot, fps, raw.path.stem, raw.cyclic)


#: Frames that are worked on at once, so that an hour of motion is not held several times over.
BLOCK = 4096


def _parts(rot: np.ndarray) -> Iterator[np.ndarray]:
    return (rot[at : at + BLOCK] for at in range(0, len(rot), BLOCK))


def _unwrapped(rot: np.ndarray) -> np.ndarray:
    """Unit quaternions `(T, J, 4)`, consecutive ones in one hemisphere."""
    out = np.array(rot, dtype=np.float64)
    for at in range(0, len(out), BLOCK):
        # The frame before is settled and tells on which side the next ones lie.
        first = max(0, at - 1)
        part = out[first : at + BLOCK]
        part[at - first :] = normalize(part[at - first :])
        part[...] = unwrap_quats(part)
    return out


#: Why a value is what it is, where nothing was guessed.
BY_FORMAT = "The format itself states it"


def evidence(options: ReadOptions, up: Guess, unit: Guess, rate: str) -> tuple[tuple[str, str], ...]:
    """Why the vertical, the unit and the frame rate are what they are, one sentence each."""
    return (
        ("up", "Stated with --up" if options.up_axis else up.note or BY_FORMAT),
        ("unit", "Stated with --unit" if options.unit_m else unit.note or BY_FORMAT),
        ("fps", "Stated with --fps" if options.fps is not None else rate),
    )


def _rate(raw: RawMotion) -> str:
    if raw.frame_time is not None:
        return f"The file's frame time is {raw.frame_time:.6g} s"
    return next((n for n in raw.notes if "frame rate" in n), BY_FORMAT)


def _check(raw: RawMotion) -> None:
    if len(raw.names) > MAX_JOINTS:
        raise PoiseError(
            f"it has {len(raw.names)} joints, more than the {MAX_JOINTS} allowed",
            raw.path,
            code="too-many-joints",
        )
    if odd := [n for n in raw.names if not n.isprintable()]:
        raise PoiseError(f"{shown(odd[0])} is no joint name", raw.path, code="not-a-name")
    check_frames(len(raw.root_pos), raw.path)
    if not np.abs(raw.offsets).max() > 0:
        raise PoiseError(
            "no bone of the skeleton has any length (all offsets are zero)",
            raw.path,
            code="skeleton-without-length",
        )


def _drop_rest_frames(raw: RawMotion, notes: list[str]) -> RawMotion:
    if raw.whole or raw.format == "deepmimic":
        return raw
    count, note = inserted_rest_frames(raw.rot)
    if not count:
        return raw
    notes.append(note)
    return replace(raw, root_pos=raw.root_pos[count:], rot=raw.rot[count:])


def _up_and_unit(raw: RawMotion, rot: np.ndarray, options: ReadOptions) -> tuple[Guess, Guess]:
    """The vertical and the metres per unit, stated or guessed, each with its evidence."""
    at = sampled(len(rot))
    pos, _ = forward_kinematics(raw.parents, raw.offsets, raw.root_pos[at], rot[at])
    height, how = body_height(raw.names, raw.parents, raw.offsets, pos)
    if not height > 0:
        raise PoiseError(
            "the skeleton has no height (all joints lie in one place)",
            raw.path,
            code="skeleton-without-length",
        )
    if options.unit_m is not None:
        unit = stated_unit(height, options.unit_m, raw.path)
    elif raw.unit_m is not None:
        unit = Guess(raw.unit_m)
    else:
        unit = guess_unit(height, how, raw.unit_hint, raw.path, raw.format)
    stated = options.up_axis or raw.up_axis
    if stated is not None:
        return Guess(stated.upper()), unit
    after = later_frames(at, options.fps or raw.fps, len(rot))
    later, _ = forward_kinematics(raw.parents, raw.offsets, raw.root_pos[after], rot[after])
    return guess_up(raw.names, pos, rest_positions(raw.parents, raw.offsets), later), unit


#: How arrays of labels are called: `(T, 4)` for left heel, left toe, right heel and right toe, as Kimodo
#: and HumanML3D have them, or `(T, 2)` for the left and the right foot.
KEYS = ("foot_contacts", "foot_contact")
#: Labels that are no truth values hold from here on; they lie within this much of 0 to 1.
HOLDS, BEYOND = 0.5, 0.5
NOTE = "The file says when the feet touch the floor: that is taken in place of a guess"
_OUT = "Its labels of foot contacts were left out"


def with_labels(clip: Clip, data: Mapping[str, Any]) -> Clip:
    """The clip with the labels of foot contacts that named arrays bring, as it is without any."""
    key = next((key for key in KEYS if key in data), None)
    return clip if key is None else labelled(clip, data[key])


def labelled(clip: Clip, value: object) -> Clip:
    """The clip with labels of its feet's contacts, `(T, 4)` or `(T, 2)`, and a note; what says nothing
    is left out, and a note says why."""
    contacts, note = _contacts(clip, np.asarray(value))
    notes = (*clip.skeleton.source.notes, note)
    return clip.replaced(skeleton=clip.skeleton.with_source(notes=notes), contacts=contacts)


def _contacts(clip: Clip, table: np.ndarray) -> tuple[tuple[tuple[int, np.ndarray], ...], str]:
    shapes = [(clip.frames, width) for width in (4, 2)]
    if table.shape not in shapes or table.dtype.kind not in "biuf":
        there = " x ".join(map(str, table.shape))
        return (), f"{_OUT}: they are {there}, not {clip.frames} x 4 truth values"
    numbers = table.astype(np.float64)
    if not ((numbers >= -BEYOND) & (numbers <= 1.0 + BEYOND)).all():
        return (), f"{_OUT}: they do not lie between 0 and 1"
    touch = numbers >= HOLDS
    if not touch.any():
        return (), f"{_OUT}: by them no foot ever touches the floor"
    try:
        roles = find_roles(clip.skeleton)
    except PoiseError:
        return (), f"{_OUT}: no joint is known as a foot"
    feet = [roles.joint(f"{side}_foot") for side in SIDES]
    if None in feet:
        return (), f"{_OUT}: no joint is known as a foot"
    half = np.repeat(touch, 2, axis=1) if touch.shape[1] == 2 else touch
    return tuple((j, half[:, 2 * k : 2 * k + 2]) for k, j in enumerate(feet) if j is not None), NOTE
