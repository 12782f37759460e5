"""VRM's humanoid bones as VMC sends them: Unity's world is left-handed, Y up, and faces +Z.

Poise's (x, y, z), Z up and facing +X, is Unity's (z, -x, y). That is a reflection, by which a rotation
about an axis turns the other way: (w, x, y, z) is Unity's (w, -z, x, -y).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from poise.errors import PoiseError
from poise.motion import Clip, Skeleton

#: Bones with their parents, from the hips on; fingers, eyes and jaw are left out.
PARENTS: dict[str, str | None] = {
    "Hips": None, "Spine": "Hips", "Chest": "Spine", "UpperChest": "Chest", "Neck": "UpperChest",
    "Head": "Neck",
    **{
        side + bone: parent if parent in ("Hips", "UpperChest") else side + parent
        for side in ("Left", "Right")
        for bone, parent in (
            ("Shoulder", "UpperChest"), ("UpperArm", "Shoulder"), ("LowerArm", "UpperArm"),
            ("Hand", "LowerArm"), ("UpperLeg", "Hips"), ("LowerLeg", "UpperLeg"), ("Foot", "LowerLeg"),
            ("Toes", "Foot"),
        )
    },
}  # fmt: skip
#: Bones that every VRM model has.
NEEDED = tuple(
    b
    for b in PARENTS
    if b not in ("Chest", "UpperChest", "Neck") and not b.endswith(("Shoulder", "Toes"))
)
#: m, T-pose of a person of 1.6 m: x ahead, y left, z up; right sides mirror left ones.
_OFFSETS = {
    "Hips": (0.0, 0.0, 0.0), "Spine": (0.0, 0.0, 0.07), "Chest": (0.0, 0.0, 0.12),
    "UpperChest": (0.0, 0.0, 0.12), "Neck": (0.0, 0.0, 0.13), "Head": (0.01, 0.0, 0.08),
    "LeftShoulder": (0.0, 0.03, 0.10), "LeftUpperArm": (0.0, 0.10, 0.0),
    "LeftLowerArm": (0.0, 0.25, 0.0), "LeftHand": (0.0, 0.23, 0.0),
    "LeftUpperLeg": (0.0, 0.09, -0.05), "LeftLowerLeg": (0.0, 0.0, -0.38),
    "LeftFoot": (0.0, 0.0, -0.39), "LeftToes": (0.12, 0.0, -0.07),
}  # fmt: skip


def from_unity(pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places `(..., 3)` and rotations `(..., 4)` xyzw of Unity as Poise's, wxyz."""
    x, y, z = np.moveaxis(pos, -1, 0)
    a, b, c, w = np.moveaxis(quat, -1, 0)
    return np.stack((z, -x, y), -1), np.stack((w, -c, a, -b), -1)


def to_unity(pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The way back."""
    x, y, z = np.moveaxis(pos, -1, 0)
    w, a, b, c = np.moveaxis(quat, -1, 0)
    return np.stack((-y, z, x), -1), np.stack((b, -c, -a, w), -1)


def skeleton_of(offsets: Mapping[str, np.ndarray]) -> Skeleton:
    """The skeleton of the bones that a model has, `(3)` m each, in Poise's axes.

    Raises:
        PoiseError: a bone that every model has is missing.
    """
    if any(bone not in offsets for bone in NEEDED):
        raise PoiseError("bones are missing", "VRM")
    names = tuple(bone for bone in PARENTS if bone in offsets)
    parents = list[int]()
    for bone in names:
        up = PARENTS[bone]
        while up is not None and up not in offsets:
            up = PARENTS[up]
        parents.append(-1 if up is None else names.index(up))
    rows = np.array([offsets[bone] for bone in names])
    rows[0] = 0.0
    return Skeleton(names, tuple(parents), rows)


def standard() -> Skeleton:
    """A model of 1.6 m in its T-pose."""
    mirror = np.array([1.0, -1.0, 1.0])
    left = {bone: np.array(at) for bone, at in _OFFSETS.items()}
    right = {
        bone.replace("Left", "Right"): at * mirror
        for bone, at in left.items()
        if bone.startswith("Left")
    }
    return skeleton_of({**left, **right})


def t_pose(skeleton: Skeleton) -> Clip:
    """The rest pose as a clip."""
    rot = np.zeros((2, len(skeleton), 4))
    rot[..., 0] = 1.0
    return Clip(skeleton, np.zeros((2, 3)), rot, 30.0, "T-pose")
