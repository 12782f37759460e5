"""Clips of the SMPL family: AMASS npz and its relatives, AIST++, without any model file; and back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.arrays import npz_bytes, numeric, one_number, refuse_bad, require, text_of
from poise.formats.guess import (
    UPS,
    Guess,
    check_radians,
    clear_axis,
    guess_up,
    later_frames,
    lean,
    supports,
)
from poise.formats.one_person import MOST_PEOPLE, one_person
from poise.formats.raw import (
    RawMotion,
    ReadOptions,
    Row,
    assemble,
    evidence,
    quats_from_z_up,
    sided,
    tree_of,
    vectors_from_z_up,
    vectors_to_z_up,
)
from poise.formats.text import listed, write_whole
from poise.motion.clip import Clip, check_poses
from poise.motion.clip_info import sampled
from poise.motion.rotations import (
    forward_kinematics,
    matrix_to_quat,
    quat_conj,
    quat_mul,
    quat_to_rotvec,
    rotvec_to_quat,
)
from poise.motion.skeleton import Channel, Skeleton, Source, triple

_SIDES = (("left", 1.0), ("right", -1.0))
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")

# The stated default body is our own plain table, from no model file: an average adult of 1.72 m in a
# T-pose, rounded to whole centimetres (fingers: halves).
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
class SmplLayout:
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


def _hand() -> list[Row]:
    """The fingers of a side."""
    return [
        (f"*_{finger}{i + 1}", f"*_{finger}{i}" if i else "*_wrist", step)
        for finger in _FINGERS
        for i, step in enumerate(_FINGER_BONES[finger])
    ]


def _layout(name: str, rows: list[Row]) -> SmplLayout:
    names, parents, offsets = tree_of(rows)
    offsets.flags.writeable = False
    tips = sorted(
        (names.index(joint), tip)
        for joint, _, tip in sided(((key, None, tip) for key, tip in _TIPS.items()), _SIDES)
        # The head ends in its tip even where a jaw and eyes follow it.
        if joint in names and (names.index(joint) not in parents or joint == "head")
    )
    return SmplLayout(name, names, parents, offsets, tuple(tips))


def _layouts() -> tuple[SmplLayout, ...]:
    body, palms = sided(_BODY, _SIDES), sided(_HANDS, _SIDES)
    hands = [row for side in _SIDES for row in sided(_hand(), (side,))]
    return (
        _layout("SMPL body", body),
        _layout("SMPL", body + palms),
        _layout("SMPL-H", body + hands),
        _layout("SMPL-X", body + list(_FACE) + hands),
    )


LAYOUTS = _layouts()
"""22 joints (66 numbers a frame), 24 (72), 52 with fingers (156), 55 with face as well (165)."""


def layout_of_width(width: int) -> SmplLayout | None:
    """The layout with `poses` of `width` numbers a frame."""
    return next((layout for layout in LAYOUTS if layout.width == width), None)


def layout_of_joints(skeleton: Skeleton) -> SmplLayout | None:
    """The layout with exactly the joints of a skeleton, None if there is none."""
    joints = skeleton.names, skeleton.parents
    return next((x for x in LAYOUTS if (x.names, x.parents) == joints), None)


_POSES = ("poses", "smpl_poses", "pose_aa", "fullpose", "pose_world")
_ROOT = ("root_orient", "global_orient")
_SMPL_BODY = ("pose_body", "body_pose")
_TRANS = ("trans", "smpl_trans", "transl", "trans_world")
_RATES = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "framerate", "fps")
_JOINTS = ("rest_joints", "J", "joints")
_UNUSED = ("dmpls", "expression", "pose_est_dmpls")
_AIST_FPS = 60.0
_HY_FPS = 30.0
#: Rates that files without a stated one have, frames/s, the usual one first.
_UNSTATED = {_AIST_FPS: (60.0, 30.0), _HY_FPS: (30.0, 60.0)}
_AMASS_RATES = ("mocap_framerate", "mocap_frame_rate")


def to_y_up(up: str) -> np.ndarray:
    """`(4,)` wxyz, the turn of a world with the vertical `up` to Y up."""
    images = vectors_from_z_up(vectors_to_z_up(np.eye(3), up), "Y")
    return matrix_to_quat(images.T)


def is_smpl(keys: Mapping[str, Any] | Sequence[str]) -> bool:
    """Whether arrays of these names are a motion of the SMPL family."""
    return _first(keys, _POSES) is not None or (
        _first(keys, _ROOT) is not None and _first(keys, _SMPL_BODY) is not None
    )


def read_smpl(data: Mapping[str, Any], path: Path, options: ReadOptions) -> Clip:
    """A clip from named arrays: `poses (T, 66|72|156|165)` rad (or its parts), `trans (T, 3)` m,
    `betas`, `gender`, `mocap_framerate`.

    A pose is one axis-angle vector per joint on a body that stands in a T-pose along Y, facing Z; the
    root's rotation takes that body into the world. The pelvis stands at `trans` plus its place in the
    model's frame.

    22, 24, 52 or 55 joints, whatever the file turns, fingers and face included. Rest joints come
    from the file (`rest_joints`, `J` or `joints`, `(J, 3)` m) or from the stated default body.

    Raises:
        PoiseError: arrays that are missing, of the wrong shape or not finite.
    """
    data, people = _of_one_person(data, options.take, path)
    poses, layout = _poses(data, path)
    scale, world_unit = _scale(data, path, options)
    trans = numeric(data, _needed(data, _TRANS, path), (None, 3), path)
    if len(trans) != len(poses):
        raise PoiseError(
            f"it has {len(poses)} poses but {len(trans)} translations", path, code="length-differs"
        )
    refuse_bad(poses, "the rotation", path, layout.names)
    refuse_bad(trans, "the translation", path)
    # Roots may turn often, and fits of fingers are wild.
    limbs = {name: poses[:, j] for j, name in enumerate(layout.names[:22]) if j}
    hint = "Convert the axis-angle vectors to radians"
    check_radians(limbs, "the SMPL family has", path, hint)
    notes = people
    pelvis, offsets = _rest(data, path, layout, notes)
    root_pos = trans / scale * world_unit + pelvis
    quat = rotvec_to_quat(poses)
    fps = options.fps or _fps(data, path, notes)
    up, up_note = _up(data, options, layout, root_pos, quat, fps)
    notes += [*up_note, *_told(data)]
    if up != "Y":
        quat[:, 0] = quat_mul(to_y_up(up), quat[:, 0])
        root_pos = vectors_from_z_up(vectors_to_z_up(root_pos, up), "Y")
    raw = RawMotion(
        format="smpl",
        path=path,
        names=layout.names,
        parents=layout.parents,
        offsets=offsets,
        ends=layout.tips,
        root_pos=root_pos,
        rot=quat,
        fps=fps,
        channels=(Channel(order=("axis-angle",)),) * len(layout.names),
        unit_m=1.0,
        up_axis="Y",
        notes=tuple(notes),
        extra=_extra(data, layout, pelvis, up),
        rates=() if _first(data, _RATES) is not None else _UNSTATED.get(fps, ()),
    )
    clip = assemble(raw, ReadOptions(fps=options.fps))
    taken = "The file states no unit: metres taken, as AMASS has it"
    taken = "Metres after division by smpl_scaling" if "smpl_scaling" in data else taken
    unit = Guess(world_unit / scale, taken)
    rate = dict(clip.skeleton.source.evidence)["fps"]
    why = evidence(options, Guess(up, "".join(up_note)), unit, rate)
    skeleton = clip.skeleton.with_source(up_axis=up, unit_m=world_unit / scale, evidence=why)
    return clip.replaced(skeleton=skeleton)


def _first(keys: Mapping[str, Any] | Sequence[str], names: Sequence[str]) -> str | None:
    return next((n for n in names if n in keys), None)


def _of_one_person(
    data: Mapping[str, Any], take: str | None, path: Path
) -> tuple[Mapping[str, Any], list[str]]:
    """The arrays of one person where `trans` is (P, T, 3) or (T, P, 3), and a note about the others."""
    key = _first(data, _TRANS)
    trans = np.zeros((0, 3)) if key is None else np.asarray(data[key])
    if trans.ndim != 3 or min(trans.shape[:2]) > MOST_PEOPLE:
        return data, []
    both, notes = trans.shape[:2], one_person(trans, 2, take, path)[1]
    out: dict[str, Any] = {}
    for name in data:
        with suppress(PoiseError):
            # Pickled arrays beside the motion stay unread.
            value = np.asarray(data[name])
            mine = value.ndim > 2 and value.shape[:2] == both
            out[name] = one_person(value, value.ndim - 1, take, path)[0] if mine else data[name]
    return out, notes


def _needed(data: Mapping[str, Any], names: Sequence[str], path: Path) -> str:
    found = _first(data, names)
    if found is None:
        require(data, names[:1], path, "this motion of the SMPL family")
    return str(found)


def _poses(data: Mapping[str, Any], path: Path) -> tuple[np.ndarray, SmplLayout]:
    """`(T, J, 3)` axis-angle vectors in rad, and the layout with that many joints."""
    key = _first(data, _POSES)
    if key is not None:
        found = np.asarray(data[key])
        check_poses(len(np.atleast_1d(found)), found.size // max(1, 3 * len(np.atleast_1d(found))), path)
        shape = (None, None, 3) if found.ndim == 3 else (None, None)
        poses = numeric({key: found}, key, shape, path)
        poses = _flat(poses)
        what = f"array '{key}'"
    else:
        poses, what = _parts(data, path), "root_orient, pose_body and the rest together"
    layout = layout_of_width(poses.shape[1])
    if layout is None:
        known = listed(f"{x.width} ({x.name})" for x in LAYOUTS)
        raise PoiseError(
            f"{what} has {poses.shape[1]} numbers a frame, which is no layout of SMPL", path,
            f"Known: {known}", code="layout-unknown",
        )  # fmt: skip
    return poses.reshape(len(poses), len(layout.names), 3), layout


def _flat(value: np.ndarray) -> np.ndarray:
    """One row per frame, even where there are no frames."""
    return value.reshape(len(value), math.prod(value.shape[1:])) if value.ndim > 1 else value


def _parts(data: Mapping[str, Any], path: Path) -> np.ndarray:
    """`(T, D)` the poses put together from the parts that some tools keep apart."""

    def part(*names: str) -> np.ndarray | None:
        key = _first(data, names)
        if key is None:
            return None
        value = np.asarray(data[key])
        return numeric({key: _flat(value)}, key, (None, None), path)

    body = [part(*_ROOT), part(*_SMPL_BODY)]
    left, right = part("left_hand_pose"), part("right_hand_pose")
    hands = part("pose_hand", "hand_pose")
    if hands is None and left is not None and right is not None:
        hands = np.concatenate((left, right), 1) if len(left) == len(right) else left
    jaw, eyes = part("pose_jaw", "jaw_pose"), part("pose_eye")
    frames = len(body[0]) if body[0] is not None else 0
    if jaw is not None or eyes is not None:
        body += [jaw if jaw is not None else np.zeros((frames, 3))]
        body += [eyes if eyes is not None else np.zeros((frames, 6))]
        hands = hands if hands is not None else np.zeros((frames, 90))
    found = [b for b in (*body, hands) if b is not None]
    if any(len(b) != frames for b in found):
        raise PoiseError(
            f"its poses have different lengths: {listed(len(b) for b in found)}",
            path,
            code="length-differs",
        )
    return np.concatenate(found, 1)


def _scale(data: Mapping[str, Any], path: Path, options: ReadOptions) -> tuple[float, float]:
    """What `trans` is divided by (AIST++ `smpl_scaling`), and metres per its unit."""
    scale = 1.0
    if "smpl_scaling" in data:
        scale = one_number(data, "smpl_scaling", path)
        if not scale > 0:
            raise PoiseError(
                f"smpl_scaling is {scale:g}, which must be above 0", path, code="out-of-range"
            )
    return scale, options.unit_m or 1.0


def _rest(
    data: Mapping[str, Any], path: Path, layout: SmplLayout, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """The pelvis in the model's frame `(3,)` and the offsets `(J, 3)`, m, Y up."""
    count = len(layout.names)
    for key in _JOINTS:
        if key not in data:
            continue
        joints = np.asarray(data[key])
        joints = joints[0] if joints.ndim == 3 and len(joints) == 1 else joints
        if joints.ndim != 2 or joints.shape[1:] != (3,) or len(joints) < count:
            continue
        joints = numeric({key: joints}, key, (None, 3), path)[:count]
        refuse_bad(joints[None], f"array '{key}': the rest place", path, layout.names)
        parents = np.maximum(layout.parents, 0)
        notes.append(f"Bone lengths come from the file's array '{key}'")
        return joints[0], np.where(np.arange(count)[:, None] > 0, joints - joints[parents], 0.0)
    notes.append(
        "The file states no bone lengths: those of Poise's default body of 1.72 m in SMPL's T-pose "
        "were taken"
    )
    return np.array(PELVIS), layout.offsets


def _up(
    data: Mapping[str, Any],
    options: ReadOptions,
    layout: SmplLayout,
    root_pos: np.ndarray,
    quat: np.ndarray,
    fps: float,
) -> tuple[str, list[str]]:
    """The world's vertical: stated, else Z as in AMASS (Y in AIST++) unless the body says otherwise.

    The keys of AMASS count as a statement: people lie and crawl in it. Only steps that it makes climb
    by more than half a body overrule them.
    """
    if options.up_axis is not None:
        return options.up_axis.upper(), []
    stated = text_of(data["up_axis"]).upper() if "up_axis" in data else ""
    if stated in UPS:
        return stated, []
    if "smpl_poses" in data:
        return "Y", ["Y up and metres after division by smpl_scaling, as AIST++ has it"]
    if not len(root_pos):
        return "Z", []
    at = sampled(len(root_pos))
    after = later_frames(at, fps, len(root_pos))
    pos, later = (
        forward_kinematics(layout.parents, layout.offsets, root_pos[k], quat[k])[0] for k in (at, after)
    )
    plain = "The file states no vertical: Z taken, as AMASS has it"
    if any(key in data for key in _AMASS_RATES):
        along = clear_axis(lean(layout.names, pos))
        if along in (None, "Z"):
            return "Z", [plain]
        borne = supports(layout.names, pos, later)
        if borne["Z"].wander > 0.5 and borne[along].cost + 0.5 < borne["Z"].cost:
            told = f"it would climb and fall along Z, and stands and steps along {along}"
            return along, [
                f"The file has the keys of AMASS, which is Z up, but the body does not fit: {told}; "
                f"{along} taken (uncertain; override with --up Z)"
            ]
        return "Z", [
            f"{plain}; the body lies along {along[-1]} (if it stands there, state --up {along})"
        ]
    guess = guess_up(layout.names, pos, None, later)
    if guess.value in ("Y", "-Y", "Z") and clear_axis(lean(layout.names, pos)) == guess.value != "Z":
        return str(guess.value), [guess.note]
    return "Z", [plain]


def _fps(data: Mapping[str, Any], path: Path, notes: list[str]) -> float:
    key = _first(data, _RATES)
    if key is not None:
        return one_number(data, key, path)
    if "smpl_poses" in data:
        notes.append("The file states no frame rate: 60 frames per second taken, as AIST++ has it")
        return _AIST_FPS
    if "Rh" in data:
        notes.append("The file states no frame rate: 30 frames per second taken, as HY-Motion has it")
        return _HY_FPS
    raise PoiseError(
        f"the file states no frame rate (none of {listed(_RATES)})",
        path,
        "State it with --fps F",
        code="rate-missing",
    )


def _told(data: Mapping[str, Any]) -> list[str]:
    """Sentences about what is in the file and changes nothing here."""
    notes = []
    if "betas" in data:
        notes.append("The body shape (betas) is kept for writing back, but changes no bone length here")
    unused = [k for k in _UNUSED if k in data]
    if unused:
        notes.append(f"Arrays that turn no joint were left out: {listed(unused)}")
    return notes


def _extra(
    data: Mapping[str, Any], layout: SmplLayout, pelvis: np.ndarray, up: str
) -> tuple[tuple[str, str], ...]:
    """What writing back needs besides the clip itself."""
    betas = np.asarray(data["betas"]) if "betas" in data else np.zeros(16)
    if betas.dtype.kind not in "fiu" or not betas.size or not np.isfinite(betas).all():
        betas = np.zeros(16)
    betas = betas.reshape(-1, betas.shape[-1] if betas.ndim else 1)[0][:400]
    gender = text_of(data["gender"], "neutral") if "gender" in data else "neutral"
    return (
        ("layout", layout.name),
        ("gender", gender[:20]),
        ("betas", _row(betas)),
        ("pelvis", _row(pelvis)),
        ("up", up),
    )


def _row(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


def smpl_skeleton(layout: str = "SMPL") -> Skeleton:
    """SMPL's joints with the stated default body in a T-pose, metres, Z up, facing -Y.

    layout: "SMPL body" (22 joints), "SMPL" (24), "SMPL-H" (52) or "SMPL-X" (55).
    """
    found = next((x for x in LAYOUTS if x.name == layout), None)
    if found is None:
        known = ", ".join(x.name for x in LAYOUTS)
        raise PoiseError(f"there is no layout '{layout}'. Known: {known}", code="layout-unknown")
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
            code="skeleton-differs",
        )
    kept = dict(clip.skeleton.source.extra) if clip.skeleton.source.format == "smpl" else {}
    up = kept.get("up", "Z")
    pelvis = _numbers(kept.get("pelvis"), np.array(PELVIS))
    quat = quats_from_z_up(clip.rot, "Y")
    root_pos = vectors_from_z_up(clip.root_pos, "Y")
    if up != "Y":
        quat[:, 0] = quat_mul(quat_conj(to_y_up(up)), quat[:, 0])
        root_pos = vectors_from_z_up(vectors_to_z_up(root_pos, "Y"), up)
    rest = vectors_from_z_up(clip.skeleton.rest_positions(), "Y") + pelvis
    arrays = {
        "poses": quat_to_rotvec(quat).reshape(clip.frames, -1),
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
