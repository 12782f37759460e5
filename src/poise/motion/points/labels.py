"""Which keypoint is which place of a human body, by the labels of the common sets."""

from __future__ import annotations

import re
from collections.abc import Sequence

Found = dict[str, tuple[int, ...]]
"""Place of the body -> indices of the keypoints; the place is their mean."""

SIDES = ("left", "right")

# Bare labels, as joints of skeletons and of pose estimators bear them (OpenPose BODY_25 and 25B, COCO,
# Halpe, Human3.6M, MediaPipe, HumanML3D and SMPL, and the joint names of BVH and ASF files).
_SIDED: dict[str, tuple[str, ...]] = {
    "hip": ("hip", "hjc", "upleg", "upperleg", "thigh", "femur"),
    "knee": ("knee", "kjc", "leg", "lowerleg", "lowleg", "shin", "calf", "tibia"),
    "ankle": ("ankle", "ajc", "foot"),
    "heel": ("heel", "calcaneus"),
    "toe": ("toebase", "toe", "toes", "ball", "forefoot", "foot"),
    "toe_tip": ("bigtoe", "smalltoe", "footindex", "toetip"),
    "collar": ("collar", "clavicle", "shoulder", "innershoulder"),
    "shoulder": ("sjc", "arm", "upperarm", "humerus", "shldr", "shoulder"),
    "elbow": ("elbow", "ejc", "forearm", "lowerarm", "radius"),
    "wrist": ("wrist", "wjc", "hand"),
    "hand": ("handtip", "fingertip", "middle1", "hand", "index", "indexfinger"),
    "ear": ("ear",),
    "eye": ("eye",),
}
_MIDDLE: dict[str, tuple[str, ...]] = {
    "pelvis": ("pelvis", "midhip", "hips", "hip", "root"),
    "neck": ("neck", "upperneck", "neck0"),
    "head": ("head", "headcenter", "headcentre"),
    "head_top": ("headtop", "topofhead", "tophead", "vertex", "site_head"),
    "face": ("nose",),
}
_SPINE = re.compile(r"(spine|chest|upperchest|torso|thorax|abdomen|lowerback|upperback|back)\d*")

NEEDED = tuple(f"{s}_{p}" for p in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist") for s in SIDES)
"""Without these no body can be posed."""


def split_label(label: str) -> tuple[str, str]:
    """The side ("left", "right", "") and the bare lower-case part of a keypoint's label.

    A subject's prefix ("Anna:LASI", "mixamorig:LeftArm") is dropped.
    """
    text = label.rsplit(":", 1)[-1].strip()
    low = text.lower()
    for side in SIDES:
        if side in low:
            return side, _bare(low.replace(side, "", 1))
    for pattern in (r"^([lr])[_. -]+(.+)$", r"^(.+)[_. -]+([lr])$", r"^.+[_. ]([lr])[_. ](.+)$"):
        match = re.match(pattern, low)
        if match:
            first, second = match.groups()
            side, core = (first, second) if first in ("l", "r") else (second, first)
            return {"l": "left", "r": "right"}[side], _bare(core)
    match = re.match(r"^([lr])(.+)$", low)
    if match and (_bare(match.group(2)) in _CORES or re.match(r"^[LR][A-Z]", text)):
        core = _bare(match.group(2))
        # "ROOT" and "RUN1" begin with R too; only known labels have a side by one letter.
        if core in _CORES:
            return {"l": "left", "r": "right"}[match.group(1)], core
    return "", _bare(low)


def _bare(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text)


def middle_label(label: str) -> bool:
    """Whether a label names a place in the body's middle (pelvis, spine, neck, head)."""
    side, core = split_label(label)
    cores = {core for cores in _MIDDLE.values() for core in cores}
    return not side and (core in cores or _SPINE.fullmatch(core) is not None)


# The labels of surface markers (Plug-in Gait, CMU, OpenCap's "_study" set), known by `markers.py`.
_MARKERS = (
    "asi psi fwt bwt kne knm mkn knem mkne ank anm mank ankm mma med hee mt1 mt5 sho elb elm melb "
    "elbm wra wrb fin fhd bhd asis psis tip thi tib upa frm shn asisstudy psisstudy kneestudy "
    "mkneestudy anklestudy manklestudy toestudy 5metastudy calcstudy shoulderstudy hjcstudy "
    "lelbowstudy melbowstudy lwriststudy mwriststudy"
)
_MIDDLE_MARKERS = {"c7", "clav", "strn", "t10", "sacr", "sacrum"}
_CORES = frozenset(c for cores in _SIDED.values() for c in cores) | frozenset(_MARKERS.split())


def known_labels() -> tuple[str, ...]:
    """Labels to suggest: one per place, as OpenPose writes them, then the places in between."""
    sided = (
        *("Hip", "Knee", "Ankle", "Shoulder", "Elbow", "Wrist"),
        *("Heel", "BigToe", "Toe", "Ear", "Eye"),
    )
    return (*(f"{s}{core}" for core in sided for s in "LR"), "MidHip", "Neck", "Head", "Nose")


def unknown_labels(labels: Sequence[str]) -> list[str]:
    """The labels that tell no place of a body."""
    known = _CORES | {core for cores in _MIDDLE.values() for core in cores} | _MIDDLE_MARKERS
    split = [split_label(label)[1] for label in labels]
    return [n for n, core in zip(labels, split, strict=True)
            if core not in known and not _SPINE.fullmatch(core)]  # fmt: skip


def find_places(labels: Sequence[str]) -> Found:
    """The places of the body that labels name outright (joints, heels, toes, nose).

    Three labels mean different places in different sets, which the others decide: "shoulder" is the
    collar where an arm is named, "foot" the toe where an ankle is named, and "hand" the finger where
    a wrist is named. Spine joints come as "spine 0", "spine 1", ... in the order of the labels.
    """
    split = [split_label(label) for label in labels]
    cores = {core for _, core in split}
    arm = bool(cores & {"arm", "upperarm", "humerus", "shldr"})
    meaning = {
        "shoulder": "collar" if arm else "shoulder",
        "foot": "toe" if cores & {"ankle", "ajc"} else "ankle",
        "hand": "hand" if cores & {"wrist", "wjc"} else "wrist",
    }
    out: Found = {}
    for side in SIDES:
        own = {core: k for k, (s, core) in reversed(list(enumerate(split))) if s == side}
        for place, options in _SIDED.items():
            hits = [own[c] for c in options if c in own and meaning.get(c, place) == place]
            if place == "toe_tip":
                # The middle of big and small toe lies on the foot's own axis.
                hits = [own[c] for c in ("bigtoe", "smalltoe") if c in own] or hits[:1]
                out.update({f"{side}_toe_tip": tuple(hits)} if hits else {})
            elif hits:
                out[f"{side}_{place}"] = (hits[0],)
    middle = {core: k for k, (s, core) in reversed(list(enumerate(split))) if not s}
    for place, options in _MIDDLE.items():
        hits = [middle[c] for c in options if c in middle]
        if hits:
            out[place] = (hits[0],)
    spine = [k for k, (s, core) in enumerate(split) if not s and _SPINE.fullmatch(core)]
    out.update({f"spine {i}": (k,) for i, k in enumerate(spine)})
    faces = any(p in out for p in ("face", "left_ear", "left_eye", "right_ear", "right_eye"))
    # Beside a nose or ears, "Head" is the top of the head (OpenPose 25B, Halpe, Human3.6M).
    if faces and "head" in out and "head_top" not in out:
        out["head_top"] = out.pop("head")
    return out
