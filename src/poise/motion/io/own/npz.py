"""Poise's own file: everything a clip holds, without loss, as arrays that any NumPy can read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.numpy.arrays import npz_bytes, numeric, one_number, refuse_bad, require, text_of
from poise.motion.io.own.record import (
    make_skeleton,
    refuse_overrides,
    source_from_json,
    source_to_json,
)
from poise.motion.io.raw import ReadOptions
from poise.motion.io.text import MAX_JOINTS, write_whole

VERSION = 1
"""The version of the format that is written; newer ones are refused."""
MARK = "poise_clip"
"""The array that names the format; it holds the version."""
_KEYS = (
    *("names", "parents", "offsets", "end_joints", "ends", "source"),
    *("root_pos", "rot", "fps", "name", "cyclic"),
)


def write_poise_npz(clip: Clip, path: str | Path) -> None:
    """Writes a clip as Poise's own npz; reading it gives an equal clip, bit by bit.

    Arrays: `poise_clip` (the format's version), `names (J,)`, `parents (J,)` (-1 for the root),
    `offsets (J, 3)` m, `end_joints (E,)` and `ends (E, 3)` m, `root_pos (T, 3)` m, `rot (T, J, 4)`
    wxyz, `fps`, `name`, `cyclic`, `source` (JSON: what writing back in the old format needs).
    Metres, Z up. The file appears whole or not at all, and the same clip gives the same bytes.

    Raises:
        PoiseError: the folder is missing or cannot be written to.
    """
    skeleton = clip.skeleton
    arrays = {
        MARK: np.array(VERSION),
        "names": np.array(skeleton.names),
        "parents": np.array(skeleton.parents, dtype=np.int64),
        "offsets": skeleton.offsets,
        "end_joints": np.array([j for j, _ in skeleton.ends], dtype=np.int64),
        "ends": np.array([tip for _, tip in skeleton.ends], dtype=np.float64).reshape(-1, 3),
        "root_pos": clip.root_pos,
        "rot": clip.rot,
        "fps": np.array(clip.fps),
        "name": np.array(clip.name),
        "cyclic": np.array(clip.cyclic),
        "source": np.array(source_to_json(skeleton.source)),
    }
    write_whole(Path(path), npz_bytes(arrays))


def read_poise_npz(data: Mapping[str, Any], path: Path, options: ReadOptions) -> Clip:
    """The clip in Poise's own npz, exactly as it was written.

    Raises:
        PoiseError: a newer version, missing arrays, or values that make no clip.
    """
    version = int(one_number(data, MARK, path))
    if not 1 <= version <= VERSION:
        raise PoiseError(
            f"the file has version {version} of Poise's clip format; this Poise reads up to {VERSION}",
            path,
            "Install a newer Poise",
        )
    require(data, _KEYS, path, "this file of Poise")
    refuse_overrides(options, path)
    names = np.asarray(data["names"])
    if names.dtype.kind != "U" or names.ndim != 1:
        raise PoiseError("array 'names' must hold one text per joint", path)
    labels = [str(n) for n in names]
    root_pos = numeric(data, "root_pos", (None, 3), path)
    rot = numeric(data, "rot", (len(root_pos), len(labels), 4), path)
    refuse_bad(root_pos, "the root position", path)
    refuse_bad(rot, "the rotation", path, labels)
    skeleton = make_skeleton(
        labels,
        _joints(data, "parents", path),
        numeric(data, "offsets", (None, 3), path),
        _joints(data, "end_joints", path),
        numeric(data, "ends", (None, 3), path),
        source_from_json(text_of(data["source"]), path),
        path,
    )
    cyclic = bool(np.all(np.asarray(data["cyclic"])))
    name = text_of(data["name"], path.stem)
    fps = options.fps or one_number(data, "fps", path)
    # What a clip refuses is told with the file, once the clip bears the file's name.
    return Clip(skeleton, root_pos, rot, fps, path.stem, cyclic).replaced(name=name)


def _joints(data: Mapping[str, Any], key: str, path: Path) -> np.ndarray:
    """Indices of joints."""
    value = numeric(data, key, (None,), path)
    if not (np.abs(value) <= MAX_JOINTS).all():
        raise PoiseError(f"array '{key}' holds a number that is no joint's", path)
    return value.astype(int)
