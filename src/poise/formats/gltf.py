"""A glTF animation as a clip: skinned or plain node trees, .glb or .gltf."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.formats.gltf_bodies import choose_joints, humanoid_of
from poise.formats.gltf_file import GltfFile, load_gltf
from poise.formats.gltf_tracks import AnimationTrack, Take, Tree, choose_take, read_tree
from poise.formats.nodes import base_of, checked_unit, even, rigid_bones, unique_names
from poise.formats.raw import RawMotion, ReadOptions, assemble
from poise.formats.text import MAX_VALUE
from poise.motion.clip import Clip, check_poses

_EVEN_SCALE = 1e-2
_SLOW_HZ = 12.0
_USUAL_HZ = 30.0
_FAST_HZ = 1000.0
# Keys off any grid are read at the next of these rates.
_UNEVEN_HZ = (30.0, 60.0, 120.0, 240.0)
# Rates that exporters write as float32 times; NTSC ones lie 0.1 % below the whole number.
_RATE_SLACK = 2e-4
_SAME_TIME = 1e-3


def read_gltf(path: Path, options: ReadOptions) -> Clip:
    """A glTF 2.0 clip (.glb, .gltf).

    Local node rotations are the clip's local rotations. The transforms of nodes above the root
    joint, such as an armature's scale of 0.01, and constant scales are baked into the bones and the
    root's path, and remembered for `write_gltf`. Of several animations the longest is taken, or
    `options.take`. glTF is in metres and Y up; a body of no human size is taken for centimetres or
    another unit, with a note.
    """
    file = load_gltf(path)
    tree = read_tree(file)
    notes: list[str] = []
    take = choose_take(file, tree, options.take, options.rest, notes)
    targeted = take.nodes("translation", "rotation")
    moving = take.nodes("translation", "rotation", varying=True)
    joints = choose_joints(tree, file, targeted, moving, notes)
    joints = _without_still_roots(tree, joints, take, moving)
    raw = _raw_motion(file, tree, take, joints, options, notes)
    return assemble(raw, options)


def _without_still_roots(tree: Tree, joints: list[int], take: Take, moving: set[int]) -> list[int]:
    """Leaves out root joints that never move and carry one joint, which does the travelling.

    They become static nodes above the root, and come back when the clip is written.
    """
    travelling = take.nodes("translation", varying=True)
    while joints[0] not in moving:
        below = [j for j in joints if tree.parents[j] == joints[0]]
        if len(below) != 1 or below[0] not in travelling:
            break
        joints = joints[1:]
    return joints


def _raw_motion(
    file: GltfFile, tree: Tree, take: Take, joints: list[int], options: ReadOptions, notes: list[str]
) -> RawMotion:
    above = tree.line(joints[0])[:-1]
    used = [
        take.tracks[n, p] for n in joints for p in ("translation", "rotation") if (n, p) in take.tracks
    ]
    when, fps = _clock(take, used, options.fps, file, notes)
    place = {n: _channel(tree, take, n, "translation", when) for n in (*above, *joints)}
    turn = {n: _channel(tree, take, n, "rotation", when) for n in (*above, *joints)}
    scale = {n: _scale(tree, take, n, file, notes) for n in (*above, *joints)}
    names = unique_names([tree.names[j] for j in joints], notes)
    index = {node: j for j, node in enumerate(joints)}
    parents = tuple(index.get(tree.parents[n], -1) if j else -1 for j, n in enumerate(joints))
    base = base_of([(place[n][0], turn[n][0], scale[n]) for n in above])
    bones = rigid_bones(
        names,
        parents,
        [place[n] for n in joints],
        [turn[n] for n in joints],
        [scale[n] for n in joints],
        base,
        len(when),
        notes,
    )
    own = take.extras
    stated = {names[j]: role for j, role in humanoid_of(file, tree, joints).items()}
    extra = (("roles", json.dumps(stated)),) if stated else ()
    kept = {
        "above": [
            [tree.names[n], place[n][0].tolist(), turn[n][0].tolist(), scale[n].tolist()] for n in above
        ],
        "scale": [even(scale[n]) for n in joints],
        "rest": tree.turn[joints].tolist(),
        "root": tree.place[joints[0]].tolist(),
        "take": take.name,
    }
    unit_m = checked_unit("glTF", 1.0, "Y", names, parents, bones, options, file.path, notes)
    return RawMotion(
        format="gltf",
        path=file.path,
        names=names,
        parents=parents,
        offsets=bones.offsets,
        ends=_ends(file, joints),
        root_pos=bones.root_pos,
        rot=bones.rot,
        fps=fps,
        channels=(),
        frame_time=_number_of(own.get("frame_time")),
        unit_m=unit_m,
        up_axis="Y",
        travel_joint=None if bones.carried.joint is None else names[bones.carried.joint],
        cyclic=own.get("cyclic") is True,
        notes=tuple(notes),
        strays=bones.carried.strays,
        beside=bones.carried.beside,
        extra=(("gltf", json.dumps(kept)), *extra, *bones.carried.extra),
        whole="fps" in own,
    )


def _channel(tree: Tree, take: Take, node: int, path: str, when: np.ndarray) -> np.ndarray:
    """`(T or 1, n)` values of a node's channel, or of its rest pose where it has none."""
    track = take.tracks.get((node, path))
    if track is None:
        return (tree.place if path == "translation" else tree.turn)[node][None]
    return track.at(when) if track.varies() else track.keys()[:1]


def _scale(tree: Tree, take: Take, node: int, file: GltfFile, notes: list[str]) -> np.ndarray:
    """`(3,)` a node's constant scale; an animated one is told and replaced by its median."""
    name, track = tree.names[node], take.tracks.get((node, "scale"))
    value = tree.scale[node] if track is None else np.median(track.keys(), axis=0)
    if track is not None and np.ptp(track.keys(), axis=0).max() > _EVEN_SCALE * np.abs(value).max():
        notes.append(f"The scale of '{name}' is animated; its median was taken for all frames")
    if value.min() <= 0:
        what = "mirrors space" if value.min() < 0 else "is zero"
        raise PoiseError(
            f"the scale of node '{name}' {what}, which no body can follow",
            file.path,
            code="scale-unusable",
        )
    if value.max() > (1 + _EVEN_SCALE) * value.min():
        notes.append(
            f"The scale of '{name}' differs between its axes; below its children the mean is used"
        )
    return value


def _ends(file: GltfFile, joints: list[int]) -> tuple[tuple[int, tuple[float, float, float]], ...]:
    """Bone tips that Poise wrote beside the nodes, in file units."""
    out: list[tuple[int, tuple[float, float, float]]] = []
    for j, node in enumerate(joints):
        extras = file.doc["nodes"][node].get("extras")
        tips = extras.get("poise_ends") if isinstance(extras, dict) else None
        for tip in tips if isinstance(tips, list) else []:
            if isinstance(tip, list) and len(tip) == 3 and all(type(x) in (int, float) for x in tip):
                x, y, z = (float(v) for v in tip)
                if max(abs(x), abs(y), abs(z)) < 1e6:
                    out.append((j, (x, y, z)))
    return tuple(out)


def _clock(
    take: Take, tracks: Sequence[AnimationTrack], fps: float | None, file: GltfFile, notes: list[str]
) -> tuple[np.ndarray, float]:
    """The times `(T,)` s at which all channels are read, and frames per second.

    The rate is the stated one, that which Poise wrote beside the keys, or the most common spacing
    of the keys. Times that are a key up to float32 noise become that key exactly.
    """
    if not tracks and take.tracks:
        raise PoiseError("the animation moves no joint of the figure", file.path, code="nothing-moves")
    if not tracks:
        return np.zeros(2), fps or _USUAL_HZ
    inputs = {id(t.times): t.times for t in tracks}.values()
    start, end = min(t[0] for t in inputs), max(t[-1] for t in inputs)
    if end <= start:
        # One pose, which stands for two frames.
        return np.full(2, start), fps or _USUAL_HZ
    own = _number_of(take.extras.get("fps"))
    if fps is not None:
        rate = fps
    elif own is not None and own < _FAST_HZ and _on_grid(list(inputs), start, 1.0 / own):
        rate = own
    else:
        rate = _guessed_rate(list(inputs), start, notes)
    # Times are float32 numbers; the last frame may lie that much before its place.
    noise = 2 * float(np.spacing(np.float32(max(abs(start), abs(end)))))
    count = int(np.floor((end - start + noise) * rate + 0.02)) + 1
    check_poses(count, len(tracks), file.path)
    when = start + np.arange(count) / rate
    keys = np.unique(np.concatenate(list(inputs)))
    near = np.clip(np.searchsorted(keys, when), 1, max(1, len(keys) - 1))
    nearest = np.where(
        np.abs(keys[near] - when) < np.abs(keys[near - 1] - when), keys[near], keys[near - 1]
    )
    same = np.abs(nearest - when) <= _SAME_TIME / rate + noise
    return np.where(same, nearest, when), rate


def _number_of(value: object) -> float | None:
    """A number above 0 from `extras`, None for anything else there."""
    return float(value) if isinstance(value, int | float) and 0 < value < MAX_VALUE else None


def _spacings(inputs: list[np.ndarray]) -> np.ndarray:
    steps = np.concatenate([np.diff(t) for t in inputs])
    return steps[steps > 1.0 / _FAST_HZ]


def _on_grid(inputs: list[np.ndarray], start: float, step: float) -> bool:
    """Whether all keys lie on `start + k step`, up to a twentieth of a step."""
    return all(np.abs((t - start) / step - np.round((t - start) / step)).max() < 0.05 for t in inputs)


def _guessed_rate(inputs: list[np.ndarray], start: float, notes: list[str]) -> float:
    steps = _spacings(inputs)
    if not len(steps):
        notes.append(
            f"The keys lie too close to tell a frame rate; {_USUAL_HZ:g} frames per second taken"
        )
        return _USUAL_HZ
    # Spacings that differ by float32 noise fall into one class of a hundredth of an octave.
    classes, counts = np.unique(np.round(np.log2(steps) * 100), return_counts=True)
    common = steps[np.round(np.log2(steps) * 100) == classes[counts.argmax()]]
    longest = max(inputs, key=len)
    step = float(np.median(common))
    even = longest[-1] - longest[0]
    whole = round(even / step)
    if whole == len(longest) - 1 and whole > 0:
        # Evenly spaced keys tell the spacing best from first to last.
        step = float(even / whole)
    rate = _round_rate(1.0 / step)
    if rate < _SLOW_HZ:
        notes.append(
            f"Most keys stand {step:.4g} s apart; they were read at {_USUAL_HZ:g} frames per second"
        )
        return _USUAL_HZ
    if not _on_grid(inputs, start, 1.0 / rate):
        rate = next((r for r in _UNEVEN_HZ if r >= rate * 0.99), rate)
        notes.append(f"The keys are not evenly spaced; they were read at {rate:.6g} frames per second")
    return rate


def _round_rate(rate: float) -> float:
    """The whole or NTSC frame rate that lies within float32 noise, else the rate itself."""
    whole = round(rate)
    for known in (float(whole), whole * 1000.0 / 1001.0):
        if whole > 0 and abs(rate / known - 1.0) < _RATE_SLACK:
            return known
    return rate
