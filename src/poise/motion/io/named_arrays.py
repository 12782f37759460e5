"""NumPy archives and pickles: what they hold decides how they are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.angles.opensim import is_opensim, read_loco
from poise.motion.io.foot_labels import labelled, with_labels
from poise.motion.io.numpy.arrays import ASK, NPY_MAGIC, Archive, first_member, npy_header, read_npy
from poise.motion.io.numpy.kimodo import is_kimodo, read_kimodo
from poise.motion.io.numpy.pickles import load_plain, loads_restricted, named_arrays
from poise.motion.io.numpy.poselib import is_poselib, read_poselib
from poise.motion.io.numpy.smpl import is_smpl, read_smpl
from poise.motion.io.numpy.smpl_write import is_amass_clip, write_amass
from poise.motion.io.own.npz import MARK, read_poise_npz, write_poise_npz
from poise.motion.io.people import one_of_dicts
from poise.motion.io.points.arrays import (
    array_points,
    is_joints,
    is_mdm,
    is_named_joints,
    is_points,
    joint_points,
    mdm_points,
    named_joint_points,
)
from poise.motion.io.points.features import CONTACTS, feature_points, is_features
from poise.motion.io.points.raw import as_clip
from poise.motion.io.raw import ReadOptions
from poise.motion.io.refused import is_qpos, refuse_array, refuse_qpos
from poise.motion.io.text import listed, shown


@dataclass(frozen=True)
class Kind:
    """Named arrays that are a motion: what they are called, how they are known, what reads them."""

    name: str
    holds: Callable[[Mapping[str, Any]], bool]
    read: Callable[[Mapping[str, Any], Path, ReadOptions], Clip]


KINDS: tuple[Kind, ...] = (
    Kind("Poise's own arrays", lambda data: MARK in data, read_poise_npz),
    Kind("AMASS and the SMPL family (poses, trans)", is_smpl, read_smpl),
    Kind("Kimodo (posed_joints)", is_kimodo, read_kimodo),
    Kind("poselib (skeleton_tree, rotation)", is_poselib, read_poselib),
    Kind("keypoints (positions, names, fps)", is_points, as_clip(array_points)),
    Kind("MDM (motion, lengths)", is_mdm, as_clip(mdm_points)),
    Kind("joints, fps", is_named_joints, as_clip(named_joint_points)),
    Kind("OpenSim coordinates (q_hip_flexion_r, ...)", is_opensim, read_loco),
    Kind("a robot's joint angles", is_qpos, refuse_qpos),
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
        raise PoiseError("this is a pickled file", path, ASK)
    value, note = one_of_dicts(load_plain(path), _is_known, options.take, path)
    clip = _read(named_arrays(value, path), path, replace(options, take=None) if note else options)
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
    raise PoiseError(f"its arrays are no motion that is known ({there})", path, f"Known: {known}")


def write_npz(clip: Clip, path: Path) -> None:
    """Writes npz: with the keys of AMASS what came from the SMPL family, else Poise's own.

    `.poise.npz` and `.amass.npz` decide it; see `write_poise_npz` and `write_amass`.
    """
    inner = Path(path.stem).suffix.lower()
    if inner == ".amass" or (inner != ".poise" and is_amass_clip(clip)):
        write_amass(clip, path)
    else:
        write_poise_npz(clip, path)
