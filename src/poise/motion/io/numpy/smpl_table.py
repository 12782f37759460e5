"""SMPL's joints, their order in each layout, and a stated default body.

The offsets are our own plain table: an average adult of 1.72 m in a T-pose, rounded to whole
centimetres (fingers: halves). They come from no model file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poise.motion.skeleton import Skeleton

_SIDES = (("left", 1.0), ("right", -1.0))
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")

# Joint, parent, offset (m; X to the person's left, Y up, Z to the front). "*" stands for a side;
# X is mirrored on the right. The order is SMPL's.
_BODY = (
    ("pelvis", None, (0.0, 0.0, 0.0)),
    ("*_hip", "pelvis", (0.07, -0.09, 0.0)),
    ("spine1", "pelvis", (0.0, 0.11, -0.02)),
    ("*_knee", "*_hip", (0.03, -0.39, 0.0)),
    ("spine2", "spine1", (0.0, 0.14, 0.01)),
    ("*_ankle", "*_knee", (-0.01, -0.40, -0.03)),
    ("spine3", "spine2", (0.0, 0.06, 0.01)),
    ("*_foot", "*_ankle", (0.03, -0.06, 0.12)),
    ("neck", "spine3", (0.0, 0.21, -0.04)),
    ("*_collar", "spine3", (0.08, 0.11, -0.03)),
    ("head", "neck", (0.0, 0.09, 0.04)),
    ("*_shoulder", "*_collar", (0.10, 0.04, -0.01)),
    ("*_elbow", "*_shoulder", (0.26, -0.01, -0.02)),
    ("*_wrist", "*_elbow", (0.25, 0.01, 0.0)),
)
_HANDS = (("*_hand", "*_wrist", (0.08, -0.01, -0.01)),)
_FACE = (
    ("jaw", "head", (0.0, 0.0, 0.02)),
    ("left_eye_smplhf", "head", (0.03, 0.07, 0.08)),
    ("right_eye_smplhf", "head", (-0.03, 0.07, 0.08)),
)
# First joint of each finger from the wrist, then the steps to the second and third joint.
_FINGER_BONES = {
    "index": ((0.10, -0.01, 0.02), (0.03, 0.0, 0.0), (0.025, 0.0, 0.0)),
    "middle": ((0.11, 0.0, 0.0), (0.03, 0.0, 0.0), (0.025, 0.0, 0.0)),
    "pinky": ((0.08, -0.01, -0.045), (0.02, 0.0, -0.005), (0.02, 0.0, 0.0)),
    "ring": ((0.095, 0.0, -0.025), (0.03, 0.0, 0.0), (0.025, 0.0, 0.0)),
    "thumb": ((0.04, -0.015, 0.03), (0.025, 0.0, 0.025), (0.025, 0.0, 0.015)),
}
# Bone tips where the layout has no further joint.
_TIPS = {
    "head": (0.0, 0.18, 0.02),
    "*_foot": (0.0, 0.0, 0.07),
    "*_wrist": (0.17, -0.01, 0.0),
    "*_hand": (0.10, 0.0, 0.0),
    "*_index3": (0.02, 0.0, 0.0),
    "*_middle3": (0.025, 0.0, 0.0),
    "*_pinky3": (0.02, 0.0, 0.0),
    "*_ring3": (0.025, 0.0, 0.0),
    "*_thumb3": (0.02, 0.0, 0.01),
}

PELVIS = (0.0, -0.22, 0.03)
"""m, the pelvis in the model's own frame, which has its origin near the chest: the pelvis stands at
`trans + PELVIS`."""


@dataclass(frozen=True)
class Layout:
    """One member of the SMPL family: which joints its `poses` turn, in their order.

    offsets `(J, 3)` m: the default body, Y up, facing +Z. tips: as `Skeleton.ends`.
    """

    name: str
    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    tips: tuple[tuple[int, tuple[float, float, float]], ...]

    @property
    def width(self) -> int:
        """Numbers per frame: three for each joint."""
        return 3 * len(self.names)


_Row = tuple[str, str | None, tuple[float, float, float]]


def _sided(name: str, side: str) -> str:
    return name.replace("*", side)


def _mirrored(v: tuple[float, float, float], sign: float) -> tuple[float, float, float]:
    return (v[0] * sign, v[1], v[2])


def _expand(rows: tuple[_Row, ...]) -> list[_Row]:
    """The rows with each sided one replaced by its left and its right one."""
    out: list[_Row] = []
    for name, parent, offset in rows:
        for side, sign in _SIDES if "*" in name else ((None, 1.0),):
            if side is None:
                out.append((name, parent, offset))
            else:
                out.append((_sided(name, side), _sided(parent or "", side), _mirrored(offset, sign)))
    return out


def _hand(side: str, sign: float) -> list[_Row]:
    out: list[_Row] = []
    for finger in _FINGERS:
        for i, step in enumerate(_FINGER_BONES[finger]):
            parent = f"{side}_{finger}{i}" if i else f"{side}_wrist"
            out.append((f"{side}_{finger}{i + 1}", parent, _mirrored(step, sign)))
    return out


def _layout(name: str, rows: list[_Row]) -> Layout:
    names = tuple(r[0] for r in rows)
    parents = tuple(-1 if r[1] is None else names.index(r[1]) for r in rows)
    tips = []
    for key, tip in _TIPS.items():
        for side, sign in _SIDES if "*" in key else (("", 1.0),):
            joint = _sided(key, side)
            # The head ends in its tip even where a jaw and eyes follow it.
            if joint in names and (names.index(joint) not in parents or key == "head"):
                tips.append((names.index(joint), _mirrored(tip, sign)))
    offsets = np.array([r[2] for r in rows])
    offsets.flags.writeable = False
    return Layout(name, names, parents, offsets, tuple(sorted(tips)))


def _layouts() -> tuple[Layout, ...]:
    body = _expand(_BODY)
    hands = [row for side, sign in _SIDES for row in _hand(side, sign)]
    return (
        _layout("SMPL body", body),
        _layout("SMPL", body + _expand(_HANDS)),
        _layout("SMPL-H", body + hands),
        _layout("SMPL-X", body + list(_FACE) + hands),
    )


LAYOUTS = _layouts()
"""22 joints (66 numbers a frame), 24 (72), 52 with fingers (156), 55 with face as well (165)."""


def layout_of_width(width: int) -> Layout | None:
    """The layout with `poses` of `width` numbers a frame."""
    return next((layout for layout in LAYOUTS if layout.width == width), None)


def layout_of_joints(skeleton: Skeleton) -> Layout | None:
    """The layout with exactly the joints of a skeleton, None if there is none."""
    joints = skeleton.names, skeleton.parents
    return next((x for x in LAYOUTS if (x.names, x.parents) == joints), None)
