"""Small NumPy files made by hand: the keys of AMASS, AIST++ and poselib on invented motion."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from poise.motion import Channel, Clip, Skeleton, Source


def amass(width: int = 156, frames: int = 12, seed: int = 0) -> dict[str, Any]:
    """A body that stands along Z, walks along -Y and waves every joint a little."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None] / 60.0
    poses = 0.3 * np.sin(3.0 * t + rng.uniform(0, 6, width))
    # The body stands along Y at rest: a quarter turn about X takes it to Z up.
    poses[:, :3] = [np.pi / 2, 0.0, 0.0] + 0.05 * np.sin(2.0 * t)
    trans = np.concatenate((0.02 * np.sin(t), -1.2 * t, 1.15 + 0.02 * np.cos(5 * t)), 1)
    return {
        "poses": poses,
        "trans": trans,
        "betas": rng.normal(size=16),
        "gender": np.array("female"),
        "mocap_framerate": np.array(60.0),
        "dmpls": np.zeros((frames, 8)),
    }


def aist(frames: int = 10) -> dict[str, Any]:
    """The dict of an AIST++ file: Y up, translations in units of `smpl_scaling`."""
    data = amass(72, frames)
    poses = data["poses"].copy()
    poses[:, :3] -= [np.pi / 2, 0.0, 0.0]
    x, y, z = data["trans"].T
    trans = np.stack((x, z, -y), -1) * 93.8
    return {
        "smpl_loss": 1.5,
        "smpl_poses": poses.astype(np.float32),
        "smpl_scaling": np.array([93.8], dtype=np.float32),
        "smpl_trans": trans.astype(np.float32),
    }


def poselib(frames: int = 8, is_local: bool = True) -> dict[str, Any]:
    """The dict of a poselib motion of five joints, one of them a sword."""
    names = ["pelvis", "torso", "head", "right_foot", "sword"]
    offsets = np.array([[0, 0, 1.0], [0, 0, 0.5], [0, 0, 0.2], [0, -0.1, -0.8], [0.3, 0, 0]])
    t = np.arange(frames)
    angle = 0.1 * t[:, None] + 0.2 * np.arange(5)
    xyzw = np.zeros((frames, 5, 4))
    xyzw[..., 1], xyzw[..., 3] = np.sin(angle / 2), np.cos(angle / 2)
    place = np.stack((0.03 * t, 0 * t, 0.9 + 0 * t), -1)
    wrap = lambda a: {"arr": a, "context": {"dtype": str(a.dtype)}}  # noqa: E731
    return {
        "rotation": wrap(xyzw),
        "root_translation": wrap(place),
        "skeleton_tree": {
            "node_names": names,
            "parent_indices": wrap(np.array([-1, 0, 1, 0, 1])),
            "local_translation": wrap(offsets.astype(np.float32)),
        },
        "is_local": is_local,
        "fps": 30,
        "__name__": "SkeletonMotion",
    }


def save_npz(path: Path, arrays: dict[str, Any]) -> Path:
    np.savez(path, **arrays)
    return path


def save_pickle(path: Path, value: Any, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(value, protocol))
    return path


def save_npy(path: Path, value: Any) -> Path:
    np.save(path, np.array(value, dtype=object), allow_pickle=True)
    return path


def odd_clip() -> Clip:
    """A clip in which every field is something that a careless format would lose."""
    rng = np.random.default_rng(3)
    rot = rng.normal(size=(7, 3, 4))
    rot /= np.linalg.norm(rot, axis=-1, keepdims=True)
    source = Source(
        format="bvh",
        path="somewhere/ä b.bvh",
        unit_m=0.0254,
        up_axis="Y",
        channels=(
            Channel(("Xposition", "Zrotation"), (0.1, 0.2, 1 / 3), "ZYX", ((-1.0, 2.0), (0.0, 0.1))),
            Channel(),
            Channel(("quat",)),
        ),
        frame_time=1 / 3,
        travel_joint="Hüfte, links",
        notes=("One thing.", 'Two "things"\nin two lines'),
        extra=(("root_position", "1 2 3"), ("empty", "")),
    )
    skeleton = Skeleton(
        ("root", "Hüfte, links", 'a "b"'),
        (-1, 0, 0),
        np.array([[0, 0, 0], [0.1, 1 / 3, -0.7], [1e-9, 0.2, 0.3]]),
        ((1, (0.1, 0.2, 1 / 7)), (1, (0.0, 0.0, 0.3)), (2, (0.5, 0.0, 0.0))),
        source,
    )
    return Clip(skeleton, rng.normal(size=(7, 3)), rot, 1000 / 33, "a, name # with ö", cyclic=True)
