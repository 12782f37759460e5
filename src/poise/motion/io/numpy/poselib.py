"""Clips of poselib (ASE, AMP): the dict of a pickled `SkeletonMotion`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.numpy.arrays import numeric, one_number, refuse_bad, require
from poise.motion.io.raw import RawMotion, ReadOptions, assemble
from poise.motion.io.text import MAX_JOINTS, listed
from poise.motion.skeleton import Channel
from poise.spatial import quat_conj, quat_mul

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
        raise PoiseError("its skeleton_tree is no dict", path)
    require(tree, ("node_names", "parent_indices", "local_translation"), path, "its skeleton_tree")
    names = tree["node_names"]
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise PoiseError("its node_names are no list of texts", path)
    if not 0 < len(names) <= MAX_JOINTS:
        raise PoiseError(f"it has {len(names)} joints; 1 to {MAX_JOINTS} are allowed", path)
    count = len(names)
    parents = tuple(int(p) for p in _inner(tree, "parent_indices", (count,), path))
    if any((p < 0) != (j == 0) or p >= j for j, p in enumerate(parents)):
        raise PoiseError("its parent_indices do not put parents before children", path)
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
        )
    quat = torch.tensor(np.roll(xyzw, 1, axis=-1))
    if is_local:
        return quat.numpy()
    above = quat[:, [max(p, 0) for p in parents]]
    local = quat_mul(quat_conj(above), quat)
    local[:, 0] = quat[:, 0]
    return local.numpy()
