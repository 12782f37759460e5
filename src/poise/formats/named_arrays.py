"""NumPy archives and pickles: their names decide how they are read; Kimodo's and poselib's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.arrays import (
    ASK,
    NPY_MAGIC,
    Archive,
    first_member,
    npy_header,
    numeric,
    one_number,
    read_npy,
    refuse_bad,
    require,
)
from poise.formats.one_person import one_of_dicts
from poise.formats.opensim import is_opensim, read_loco
from poise.formats.own import MARK, read_poise_npz, write_poise_npz
from poise.formats.pickles import load_plain, loads_restricted, named_arrays
from poise.formats.point_arrays import (
    CONTACTS,
    array_points,
    feature_points,
    is_features,
    is_joints,
    is_mdm,
    is_named_joints,
    is_points,
    joint_points,
    mdm_points,
    named_joint_points,
)
from poise.formats.point_raw import as_clip
from poise.formats.raw import RawMotion, ReadOptions, assemble, labelled, with_labels
from poise.formats.refused import is_qpos, refuse_array, refuse_qpos
from poise.formats.sam3d import is_sam3d, sam3d_points, stacked
from poise.formats.smpl import LAYOUTS, is_amass_clip, is_smpl, read_smpl, write_amass
from poise.formats.text import MAX_JOINTS, listed, shown
from poise.motion.clip import Clip
from poise.motion.rotations import matrix_to_quat, quat_conj, quat_mul
from poise.motion.skeleton import Channel

_FPS = 30.0
_SIDES = ("Left", "Right")
_TRUNK = (
    *(("Hips", ""), ("Spine1", "Hips"), ("Spine2", "Spine1"), ("Chest", "Spine2"), ("Neck1", "Chest")),
    *(("Neck2", "Neck1"), ("Head", "Neck2"), ("HeadEnd", "Head"), ("Jaw", "Head")),
    *(("LeftEye", "Head"), ("RightEye", "Head")),
)
_FINGERS = ("Index", "Middle", "Ring", "Pinky")
_Rows = tuple[tuple[str, str], ...]


def _chain(*names: str) -> _Rows:
    """Each joint with the one before as its parent; the first is the parent of the second alone."""
    return tuple(zip(names[1:], names[:-1], strict=True))


def _arm(side: str) -> _Rows:
    return _chain("Chest", *(f"{side}{part}" for part in ("Shoulder", "Arm", "ForeArm", "Hand")))


def _fingers(side: str) -> _Rows:
    hand = f"{side}Hand"
    out = _chain(hand, *(f"{hand}Thumb{k}" for k in ("1", "2", "3", "End")))
    for finger in _FINGERS:
        out += _chain(hand, *(f"{hand}{finger}{k}" for k in ("1", "2", "3", "4", "End")))
    return out


def _leg(side: str, *end: str) -> _Rows:
    return _chain("Hips", *(f"{side}{part}" for part in ("Leg", "Shin", "Foot", "ToeBase", *end)))


def _few(side: str) -> _Rows:
    hand = f"{side}Hand"
    return ((f"{hand}ThumbEnd", hand), (f"{hand}MiddleEnd", hand))


def _soma(full: bool) -> _Rows:
    rows = _TRUNK if full else tuple(r for r in _TRUNK if r[0] != "HeadEnd")
    for side in _SIDES:
        rows += _arm(side) + (_fingers(side) if full else _few(side))
    for side in _SIDES:
        rows += _leg(side, "ToeEnd") if full else _leg(side)
    return rows


def _skeletons() -> dict[int, tuple[tuple[str, ...], tuple[int, ...]]]:
    out: dict[int, tuple[tuple[str, ...], tuple[int, ...]]] = {}
    for rows in (_soma(True), _soma(False)):
        names = tuple(n for n, _ in rows)
        out[len(names)] = names, tuple(names.index(p) if p else -1 for _, p in rows)
    body = LAYOUTS[0]
    return out | {len(body.names): (body.names, body.parents)}


SKELETONS = _skeletons()
"""Names and parents by the number of joints: SOMA with 77 or 30, the body of SMPL-X with 22."""
ROBOT = 34
"""Joints of Kimodo's robot."""


def is_kimodo(data: Mapping[str, Any]) -> bool:
    """Whether named arrays are a motion of Kimodo."""
    return "posed_joints" in data and "global_rot_mats" in data


def read_kimodo(data: Mapping[str, Any], path: Path, options: ReadOptions) -> Clip:
    """A clip from `posed_joints (T, J, 3)` m and `global_rot_mats (T, J, 3, 3)`, at 30 frames a second.

    Bones are the medians of what the joints' places tell.

    Raises:
        PoiseError: a robot's motion, another number of joints, arrays that do not fit together.
    """
    require(data, ("posed_joints", "global_rot_mats"), path, "a motion of Kimodo")
    pos = numeric(data, "posed_joints", (None, None, 3), path)
    count = pos.shape[1]
    if count == ROBOT:
        raise PoiseError(
            "it is the motion of a robot (G1)",
            path,
            "Give a motion of SOMA or SMPL-X",
            code="robot-motion",
        )
    if count not in SKELETONS:
        known = ", ".join(str(n) for n in sorted(SKELETONS))
        raise PoiseError(
            f"a motion of Kimodo with {count} joints is not known",
            path,
            f"Known: {known}",
            code="layout-unknown",
        )
    names, parents = SKELETONS[count]
    turns = numeric(data, "global_rot_mats", (len(pos), count, 3, 3), path)
    refuse_bad(pos, "the place", path, names)
    refuse_bad(turns.reshape(len(pos), count, 9), "the rotation", path, names)
    local, offsets = turns.copy(), np.zeros((count, 3))
    for j, p in enumerate(parents):
        if p < 0:
            continue
        back = turns[:, p].transpose(0, 2, 1)
        local[:, j] = back @ turns[:, j]
        bone = np.einsum("tab,tb->ta", back, pos[:, j] - pos[:, p])
        offsets[j] = np.median(bone, 0) if len(bone) else 0.0
    notes = () if options.fps else ("The file states no frame rate: 30 taken, as Kimodo has it",)
    raw = RawMotion(
        format="kimodo",
        path=path,
        names=names,
        parents=parents,
        offsets=offsets,
        ends=(),
        root_pos=pos[:, 0],
        rot=matrix_to_quat(local),
        fps=options.fps or _FPS,
        channels=(Channel(order=("axis-angle",)),) * count,
        unit_m=1.0,
        up_axis="Y",
        notes=notes,
    )
    return assemble(raw, options)


_PROPS = ("sword", "shield", "weapon", "club", "racket", "ball")
_NORM_SLACK = 0.01


def is_poselib(data: Mapping[str, Any]) -> bool:
    """Whether a dict is a poselib motion."""
    return "skeleton_tree" in data and "rotation" in data


def read_poselib(data: Mapping[str, Any], path: Path, options: ReadOptions) -> Clip:
    """A clip from a poselib dict: `rotation (T, J, 4)` xyzw, local or global as `is_local` says,
    `root_translation (T, 3)`, `fps`, `skeleton_tree`; metres, Z up.

    Raises:
        PoiseError: parts that are missing, of the wrong shape or not finite.
    """
    require(
        data,
        ("rotation", "root_translation", "skeleton_tree", "fps", "is_local"),
        path,
        "this poselib motion",
    )
    tree = data["skeleton_tree"]
    if not isinstance(tree, dict):
        raise PoiseError("its skeleton_tree is no dict", path, code="wrong-type")
    require(tree, ("node_names", "parent_indices", "local_translation"), path, "its skeleton_tree")
    names = tree["node_names"]
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise PoiseError("its node_names are no list of texts", path, code="wrong-type")
    if not 0 < len(names) <= MAX_JOINTS:
        raise PoiseError(
            f"it has {len(names)} joints; 1 to {MAX_JOINTS} are allowed", path, code="joint-count"
        )
    count = len(names)
    parents = tuple(int(p) for p in _inner(tree, "parent_indices", (count,), path))
    if any((p < 0) != (j == 0) or p >= j for j, p in enumerate(parents)):
        raise PoiseError(
            "its parent_indices do not put parents before children", path, code="parent-order"
        )
    offsets = _inner(tree, "local_translation", (count, 3), path)
    refuse_bad(offsets[None], "the rest place", path, names)
    xyzw = _inner(data, "rotation", (None, count, 4), path)
    root_pos = _inner(data, "root_translation", (len(xyzw), 3), path)
    refuse_bad(xyzw, "the rotation", path, names)
    refuse_bad(root_pos, "the root position", path)
    rot = _local(xyzw, parents, bool(data["is_local"]), names, path)
    fps = one_number(data, "fps", path)
    props = [n for n in names if n.lower() in _PROPS]
    note = f"Held things are kept as joints: {listed(props)}"
    raw = RawMotion(
        format="poselib",
        path=path,
        names=tuple(names),
        parents=parents,
        # The root's own offset is its place in the model, which the translation already holds.
        offsets=np.where(np.arange(count)[:, None] > 0, offsets, 0.0),
        ends=(),
        root_pos=root_pos,
        rot=rot,
        fps=fps,
        channels=(Channel(order=("quat",)),) * count,
        unit_m=1.0,
        up_axis="Z",
        notes=(note,) if props else (),
    )
    return assemble(raw, options)


def _inner(data: Mapping[str, Any], key: str, shape: tuple[int | None, ...], path: Path) -> np.ndarray:
    """The array that poselib wraps as `{"arr": ..., "context": ...}`."""
    value = data[key]
    value = value.get("arr") if isinstance(value, dict) else value
    return numeric({key: value}, key, shape, path)


def _local(
    xyzw: np.ndarray, parents: tuple[int, ...], is_local: bool, names: list[str], path: Path
) -> np.ndarray:
    """`(T, J, 4)` wxyz in the parents' frames, of unit length."""
    norm = np.linalg.norm(xyzw, axis=-1)
    if len(norm) and np.abs(norm - 1).max() > _NORM_SLACK:
        frame, joint = np.argwhere(np.abs(norm - 1) > _NORM_SLACK)[0]
        raise PoiseError(
            f"the quaternion of joint '{names[joint]}' has length {norm[frame, joint]:.3g}, no rotation",
            f"{path}, frame {frame}",
            code="not-a-rotation",
        )
    quat = np.roll(xyzw, 1, axis=-1)
    if is_local:
        return quat
    above = quat[:, [max(p, 0) for p in parents]]
    local = quat_mul(quat_conj(above), quat)
    local[:, 0] = quat[:, 0]
    return local


@dataclass(frozen=True)
class ArrayKind:
    """Named arrays that are a motion: what they are called, how they are known, what reads them."""

    name: str
    holds: Callable[[Mapping[str, Any]], bool]
    read: Callable[[Mapping[str, Any], Path, ReadOptions], Clip]


KINDS: tuple[ArrayKind, ...] = (
    ArrayKind("Poise's own arrays", lambda data: MARK in data, read_poise_npz),
    ArrayKind("AMASS and the SMPL family (poses, trans)", is_smpl, read_smpl),
    ArrayKind("Kimodo (posed_joints)", is_kimodo, read_kimodo),
    ArrayKind("poselib (skeleton_tree, rotation)", is_poselib, read_poselib),
    ArrayKind("keypoints (positions, names, fps)", is_points, as_clip(array_points)),
    ArrayKind("SAM 3D Body (pred_keypoints_3d)", is_sam3d, as_clip(sam3d_points)),
    ArrayKind("MDM (motion, lengths)", is_mdm, as_clip(mdm_points)),
    ArrayKind("joints, fps", is_named_joints, as_clip(named_joint_points)),
    ArrayKind("OpenSim coordinates (q_hip_flexion_r, ...)", is_opensim, read_loco),
    ArrayKind("a robot's joint angles", is_qpos, refuse_qpos),
)
"""Named arrays that are known, whether they come from `.npz`, `.npy` or `.pkl`; first match reads."""


def looks_like_npz(head: bytes) -> bool:
    """Whether a file's first bytes are those of a zip that begins with an array."""
    return first_member(head).endswith(b".npy")


def looks_like_pickle(head: bytes) -> bool:
    """Whether a file's first bytes are those of a pickle (protocol 2 or later) or of a `.npy`."""
    return head.startswith(NPY_MAGIC) or (head[:1] == b"\x80" and head[1:2] in b"\x02\x03\x04\x05")


def read_npz(path: Path, options: ReadOptions) -> Clip:
    """The clip in a `.npz`, by the names of its arrays."""
    return _read(Archive(path, loads_restricted if options.allow_pickle else None), path, options)


def read_pickled(path: Path, options: ReadOptions) -> Clip:
    """The clip in a `.npy` of joints; or in a `.pkl` or `.npy` of pickled arrays, to be asked for."""
    with path.open("rb") as file:
        if file.read(len(NPY_MAGIC)) == NPY_MAGIC:
            file.seek(0)
            header = npy_header(file, path)
            if is_joints(header.shape, header.dtype):
                file.seek(0)
                return as_clip(joint_points)(read_npy(file, path), path, options)
            if is_features(header.shape, header.dtype):
                file.seek(0)
                table = read_npy(file, path)
                return labelled(as_clip(feature_points)(table, path, options), table[:, CONTACTS])
            if not header.dtype.hasobject:
                refuse_array(header.shape, path)
    if not options.allow_pickle:
        raise PoiseError("this is a pickled file", path, ASK, code="pickle-refused")
    value, note = load_plain(path), list[str]()
    if (frames := stacked(value, options.take, path)) is not None:
        return _read(frames, path, options)
    value, note = one_of_dicts(value, _is_known, options.take, path)
    clip = _read(named_arrays(value, path), path, replace(options, take=None) if note else options)
    source = clip.skeleton.source
    return clip.replaced(skeleton=clip.skeleton.with_source(notes=(*note, *source.notes)))


def looks_like_torch(head: bytes) -> bool:
    """True if a file's first bytes are those of a zip that begins with the pickle of torch."""
    return first_member(head).endswith(b"/data.pkl")


def read_torch(path: Path, options: ReadOptions) -> Clip:
    """The clip in a file of `torch.save`, such as GVHMR's; to be asked for as pickles are."""
    from poise.formats.torch_files import is_gvhmr, load_torch

    if not options.allow_pickle:
        raise PoiseError("this is a pickled file of torch", path, ASK, code="pickle-refused")
    value, note = load_torch(path), ()
    if (frames := stacked(value, options.take, path)) is not None:
        value = frames
    elif is_gvhmr(value):
        # GVHMR's world has gravity along -Y.
        value = {"up_axis": "Y", **value["smpl_params_global"]}
        note = ("GVHMR's motion in the world, Y up; that in the camera's frame was left",)
    clip = _read(named_arrays(value, path), path, options)
    source = clip.skeleton.source
    return clip.replaced(skeleton=clip.skeleton.with_source(notes=(*note, *source.notes)))


def _is_known(data: Mapping[str, Any]) -> bool:
    return any(kind.holds(data) for kind in KINDS[:-1])


def _read(data: Mapping[str, Any], path: Path, options: ReadOptions) -> Clip:
    for kind in KINDS:
        if kind.holds(data):
            return with_labels(kind.read(data, path, options), data)
    there = listed((shown(k) for k in data), 4) if len(data) else "none at all"
    known = "; ".join(kind.name for kind in KINDS[:-1])
    raise PoiseError(
        f"its arrays are no motion that is known ({there})",
        path,
        f"Known: {known}",
        code="layout-unknown",
    )


def write_npz(clip: Clip, path: Path) -> None:
    """Writes npz: with the keys of AMASS what came from the SMPL family, else Poise's own.

    `.poise.npz` and `.amass.npz` decide it; see `write_poise_npz` and `write_amass`.
    """
    inner = Path(path.stem).suffix.lower()
    if inner == ".amass" or (inner != ".poise" and is_amass_clip(clip)):
        write_amass(clip, path)
    else:
        write_poise_npz(clip, path)
