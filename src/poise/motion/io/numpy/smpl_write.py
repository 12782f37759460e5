"""Clips on SMPL's joints as npz files with the keys of AMASS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.numpy.arrays import npz_bytes
from poise.motion.io.numpy.smpl import to_y_up
from poise.motion.io.numpy.smpl_table import LAYOUTS, PELVIS, layout_of_joints
from poise.motion.io.raw import quats_from_z_up, vectors_from_z_up, vectors_to_z_up
from poise.motion.io.text import write_whole
from poise.motion.skeleton import Skeleton, Source, triple
from poise.spatial import quat_conj, quat_mul, quat_to_rotvec


def smpl_skeleton(layout: str = "SMPL") -> Skeleton:
    """SMPL's joints with the stated default body in a T-pose, metres, Z up, facing -Y.

    layout: "SMPL body" (22 joints), "SMPL" (24), "SMPL-H" (52) or "SMPL-X" (55).
    """
    found = next((x for x in LAYOUTS if x.name == layout), None)
    if found is None:
        known = ", ".join(x.name for x in LAYOUTS)
        raise PoiseError(f"there is no layout '{layout}'. Known: {known}")
    tips = tuple((j, triple(vectors_to_z_up(np.array(tip), "Y"))) for j, tip in found.tips)
    offsets = vectors_to_z_up(found.offsets, "Y")
    return Skeleton(found.names, found.parents, offsets, tips, Source(format="smpl"))


def is_amass_clip(clip: Clip) -> bool:
    """Whether a clip came from the SMPL family and can go back to it."""
    return clip.skeleton.source.format == "smpl" and layout_of_joints(clip.skeleton) is not None


def write_amass(clip: Clip, path: str | Path) -> None:
    """Writes a clip on SMPL's joints as npz with the keys of AMASS.

    `poses (T, D)` rad and `trans (T, 3)` m in the vertical the clip came with (else Z up),
    `betas`, `gender`, `mocap_framerate`, and besides them `rest_joints (J, 3)` m in the model's
    frame and `up_axis`, which make reading back exact.

    Raises:
        PoiseError: the clip is on another skeleton, or the folder cannot be written to.
    """
    layout = layout_of_joints(clip.skeleton)
    if layout is None:
        raise PoiseError(
            f"the clip's {len(clip.skeleton)} joints are not those of SMPL, which AMASS files need",
            clip.name,
            "Retarget it to SMPL's skeleton first, or write .poise.npz, which holds any skeleton",
        )
    kept = dict(clip.skeleton.source.extra) if clip.skeleton.source.format == "smpl" else {}
    up = kept.get("up", "Z")
    pelvis = _numbers(kept.get("pelvis"), np.array(PELVIS))
    quat = torch.tensor(quats_from_z_up(clip.rot, "Y"))
    root_pos = vectors_from_z_up(clip.root_pos, "Y")
    if up != "Y":
        quat[:, 0] = quat_mul(quat_conj(to_y_up(up)), quat[:, 0])
        root_pos = vectors_from_z_up(vectors_to_z_up(root_pos, "Y"), up)
    rest = vectors_from_z_up(clip.skeleton.rest_positions(), "Y") + pelvis
    arrays = {
        "poses": quat_to_rotvec(quat).reshape(clip.frames, -1).numpy(),
        "trans": root_pos - pelvis,
        "betas": _numbers(kept.get("betas"), np.zeros(16)),
        "gender": np.array(kept.get("gender", "neutral")),
        "mocap_framerate": np.array(clip.fps),
        "rest_joints": rest,
        "up_axis": np.array(up),
    }
    write_whole(Path(path), npz_bytes(arrays))


def _numbers(text: str | None, default: np.ndarray) -> np.ndarray:
    return default if text is None else np.array([float(x) for x in text.split()])
