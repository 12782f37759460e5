"""Keypoints named by their labels as places of a body; joint centres from surface markers."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

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
    return [
        n
        for n, core in zip(labels, split, strict=True)
        if core not in known and not _SPINE.fullmatch(core)
    ]


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


Tracks = dict[str, np.ndarray]
Estimate = tuple[Tracks, str]
"""Tracks of some places, and the sentence that tells how they were estimated."""

# Half the width of a joint and a marker's radius, as shares of the standing height (Winter 2009; the
# shoulder's centre lies 17 % of the distance of the acromia below them, Rab et al. 2002).
_KNEE, _ANKLE, _ELBOW, _SHOULDER = 0.030, 0.021, 0.022, 0.17
_SHIN_SHARE = 0.246
_STRAIGHT = 0.3
# The lumbar point that shows the pelvis' tilt, along the line from hips to shoulders.
_LUMBAR = 0.18


def marker_places(
    names: Sequence[str], positions: np.ndarray, known: Tracks
) -> tuple[Tracks, list[str]]:
    """Tracks `(T, 3)` of the places that surface markers tell (NaN where missing), and notes.

    The markers are those of Plug-in Gait, the CMU set and OpenCap's augmented ones, whose names end in
    "_study". With L or R before them: ASI and PSI (or FWT and BWT, or a middle SACR), KNE with a medial
    KNM or MKN, ANK with a medial ANM or MMA, HEE, TOE, MT1 and MT5, SHO, ELB with a medial ELM, WRA and
    WRB, FIN, FHD and BHD; in the middle C7, CLAV, STRN and T10. Other markers (thigh and shank wands,
    offsets) are left out.

    positions: `(T, K, 3)` m, Z up. known: places that are named outright, which stay as they are.
    """
    m = _Markers(names, positions)
    out: Tracks = {}
    notes: list[str] = []
    for side in SIDES:
        _put(out, f"{side}_heel", m.first(side, "hee", "calcstudy"))
        toe = m.first(side, "toestudy")
        _put(out, f"{side}_toe", m.middle(side, ("mt1",), ("mt5",)) if toe is None else toe)
        _put(out, f"{side}_wrist", m.middle(side, ("wra", "lwriststudy"), ("wrb", "mwriststudy")))
        _put(out, f"{side}_hand", m.first(side, "fin"))
    for estimate in (_shoulders, _legs, _elbows, _hips, _head_and_trunk, _lumbar):
        made, note = estimate(m, {**out, **known})
        out.update(made)
        if note and not set(made) <= set(known):
            notes.append(note)
    return out, notes


class _Markers:
    """Tracks by side and bare label."""

    def __init__(self, names: Sequence[str], positions: np.ndarray):
        self.at: dict[tuple[str, str], np.ndarray] = {}
        for k in reversed(range(len(names))):
            self.at[split_label(names[k])] = positions[:, k]

    def first(self, side: str, *cores: str) -> np.ndarray | None:
        """The first of these markers that there is."""
        return next((self.at[side, c] for c in cores if (side, c) in self.at), None)

    def middle(self, side: str, one: tuple[str, ...], other: tuple[str, ...]) -> np.ndarray | None:
        """The middle of two markers, None where either is not there."""
        a, b = self.first(side, *one), self.first(side, *other)
        return None if a is None or b is None else (a + b) / 2


def _put(out: Tracks, place: str, track: np.ndarray | None) -> None:
    if track is not None:
        out[place] = track


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


def _shoulders(m: _Markers, have: Tracks) -> Estimate:
    """The joint lies below the acromion, along the trunk."""
    left, right = (m.first(s, "sho", "shoulderstudy") for s in SIDES)
    pelvis = _pelvis(m)
    if left is None or right is None or pelvis is None:
        return {}, ""
    width = np.nanmedian(np.linalg.norm(left - right, axis=-1))
    down = _unit(np.mean(list(pelvis.values()), axis=0) - (left + right) / 2)
    shift = _SHOULDER * width * down
    note = f"Shoulder joints taken {_SHOULDER * width * 1e3:.0f} mm below the shoulder markers"
    return {"left_shoulder": left + shift, "right_shoulder": right + shift}, note


def _legs(m: _Markers, have: Tracks) -> Estimate:
    """Knees and ankles: between two markers of the joint, else inwards from the outer one."""
    out: Tracks = {}
    single = []
    for side in SIDES:
        knee = m.middle(side, ("kne", "kneestudy"), ("knm", "mkn", "knem", "mkne", "mkneestudy"))
        medial = ("anm", "mank", "ankm", "mma", "med", "manklestudy")
        ankle = m.middle(side, ("ank", "anklestudy"), medial)
        outer = {"knee": m.first(side, "kne", "kneestudy"), "ankle": m.first(side, "ank", "anklestudy")}
        k = outer["knee"] if knee is None else knee
        a = outer["ankle"] if ankle is None else ankle
        if k is None or a is None:
            continue
        height = np.nanmedian(np.linalg.norm(k - a, axis=-1)) / _SHIN_SHARE
        inwards = _inwards(side, k, a, have)
        if knee is None and inwards is not None:
            knee = k + _KNEE * height * inwards
            single.append(f"{side} knee")
        if ankle is None and inwards is not None:
            ankle = a + _ANKLE * height * inwards
            single.append(f"{side} ankle")
        _put(out, f"{side}_knee", k if knee is None else knee)
        _put(out, f"{side}_ankle", a if ankle is None else ankle)
    note = (
        f"Only outer markers show the {', '.join(single)}: the joints were put inwards by the half "
        "width that is usual at this height (some millimetres wrong)"
    )
    return out, note if single else ""


def _inwards(side: str, knee: np.ndarray, ankle: np.ndarray, have: Tracks) -> np.ndarray | None:
    """From the outer side of a leg to the inner one, square to shin and foot."""
    front = have.get(f"{side}_toe")
    if front is None:
        front = have.get(f"{side}_toe_tip")
    if front is None:
        return None
    # Up x forward is left: inwards for the right leg.
    left = _unit(np.cross(knee - ankle, front - have.get(f"{side}_heel", ankle)))
    return -left if side == "left" else left


def _elbows(m: _Markers, have: Tracks) -> Estimate:
    """Between two markers of the elbow, else inwards along the axis about which it bends."""
    out: Tracks = {}
    single = []
    for side in SIDES:
        middle = m.middle(side, ("elb", "lelbowstudy"), ("elm", "melb", "elbm", "melbowstudy"))
        outer = m.first(side, "elb")
        shoulder, wrist = have.get(f"{side}_shoulder"), have.get(f"{side}_wrist")
        if middle is not None:
            out[f"{side}_elbow"] = middle
        elif outer is not None and shoulder is not None and wrist is not None:
            upper, lower = outer - shoulder, wrist - outer
            # The flexion axis points inwards at the left elbow and outwards at the right one.
            axis = np.cross(_unit(upper), _unit(lower))
            sine = np.linalg.norm(axis, axis=-1, keepdims=True)
            shift = _unit(axis) * np.minimum(sine / _STRAIGHT, 1.0)
            height = _height(have)
            out[f"{side}_elbow"] = outer + (1 if side == "left" else -1) * _ELBOW * height * shift
            single.append(f"{side} elbow")
    note = f"Only outer markers show the {', '.join(single)}: put inwards by {_ELBOW * 100:.1f} % "
    note += "of the height"
    return out, note if single else ""


def _height(have: Tracks) -> float:
    """Standing height in metres from the shins, 1.7 where they are not known."""
    pairs = [(have.get(f"{s}_knee"), have.get(f"{s}_ankle")) for s in SIDES]
    found = [float(np.nanmedian(np.linalg.norm(k - a, axis=-1))) for k, a in pairs
             if k is not None and a is not None]  # fmt: skip
    return float(np.mean(found)) / _SHIN_SHARE if found else 1.7


def _pelvis(m: _Markers) -> Tracks | None:
    """Left and right front, and the middle of the back of the pelvis, None where they are not marked."""
    left, right = (m.first(s, "asi", "asis", "asisstudy", "fwt") for s in SIDES)
    backs = [m.first(s, "psi", "psis", "psisstudy", "bwt") for s in SIDES]
    back = m.first("", "sacr", "sacrum")
    if back is None and backs[0] is not None and backs[1] is not None:
        back = (backs[0] + backs[1]) / 2
    if left is None or right is None or back is None:
        return None
    return {"left": left, "right": right, "back": back}


def _axes(pelvis: Tracks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors `(T, 3)` to the left, forward and up of the plane through the pelvis' markers."""
    left = _unit(pelvis["left"] - pelvis["right"])
    ahead = (pelvis["left"] + pelvis["right"]) / 2 - pelvis["back"]
    up = _unit(np.cross(ahead, left))
    return left, np.cross(left, up), up


def _hips(m: _Markers, have: Tracks) -> Estimate:
    """Hip joint centres by the regression of Harrington et al. 2007 on the pelvis' markers."""
    out: Tracks = {}
    for side in SIDES:
        _put(out, f"{side}_hip", m.first(side, "hjcstudy"))
    pelvis = _pelvis(m)
    if pelvis is None or len(out) == len(SIDES):
        return out, ""
    left, ahead, up = _axes(pelvis)
    front = (pelvis["left"] + pelvis["right"]) / 2
    width = np.nanmedian(np.linalg.norm(pelvis["left"] - pelvis["right"], axis=-1))
    depth = np.nanmedian(np.linalg.norm(front - pelvis["back"], axis=-1))
    # x = -0.24 PD - 9.9 mm ahead, y = -0.30 PW - 10.9 mm up, z = 0.33 PW + 7.3 mm outwards
    for side, sign in (("left", 1.0), ("right", -1.0)):
        out[f"{side}_hip"] = (
            front
            - (0.24 * depth + 0.0099) * ahead
            - (0.30 * width + 0.0109) * up
            + sign * (0.33 * width + 0.0073) * left
        )
    note = (
        f"Hip joints estimated from the pelvis' markers (width {width * 1e3:.0f} mm, depth "
        f"{depth * 1e3:.0f} mm; Harrington et al. 2007)"
    )
    return out, note


def _head_and_trunk(m: _Markers, have: Tracks) -> Estimate:
    out: Tracks = {}
    fronts, backs = ([m.first(s, core) for s in SIDES] for core in ("fhd", "bhd"))
    if fronts[0] is not None and fronts[1] is not None and backs[0] is not None and backs[1] is not None:
        out["face"] = (fronts[0] + fronts[1]) / 2
        out["head"] = (fronts[0] + fronts[1] + backs[0] + backs[1]) / 4
    neck, chest = m.middle("", ("c7",), ("clav",)), m.middle("", ("t10",), ("strn",))
    _put(out, "neck", neck)
    _put(out, "spine 50", chest)
    return out, ""


def _lumbar(m: _Markers, have: Tracks) -> Estimate:
    """A point above the hips that moves with the pelvis' markers, so that they show its tilt."""
    pelvis = _pelvis(m)
    needed = [f"{s}_{p}" for p in ("hip", "shoulder") for s in SIDES]
    if pelvis is None or not all(place in have for place in needed):
        return {}, ""
    hips = (have["left_hip"] + have["right_hip"]) / 2
    line = (have["left_shoulder"] + have["right_shoulder"]) / 2 - hips
    frame = np.stack(_axes(pelvis), -1)
    own = np.nanmedian(np.einsum("tij,ti->tj", frame, _LUMBAR * line), axis=0) * (0.0, 1.0, 1.0)
    return {"spine 0": hips + frame @ own}, ""
