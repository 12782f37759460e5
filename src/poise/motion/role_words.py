"""The words by which joints of human skeletons are named, by convention."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

#: Bare lower-case names by the part they mean, best first; a share below 1, behind a colon, says that
#: other programs mean another part by the same word.
_NAMED = {
    "hips": "hips pelvis hip root:0.6 torso:0.3",
    "spine": (
        "spine chest abdomen thorax upperchest lowerback upperback torso:0.9 back waist midspine "
        "spineupper spinelower abdomenlower abdomenupper chestlower chestupper belly sternum:0.8 "
        "ribs:0.8 lumbar spinemid spinemiddle"
    ),
    "neck": "neck lowerneck upperneck neckbase necklower neckupper",
    "head": "head skull",
    "clavicle": "clavicle collar collarbone clav scapula:0.9 shoulder:0.8",
    "upper_arm": "upperarm arm humerus shldr uparm shoulder:0.8 bicep shldrbend armupper",
    "forearm": "forearm lowerarm elbow radius ulna lowarm loarm forearmbend armlower",
    "hand": "hand wrist palm:0.4",
    "thigh": "thigh upleg upperleg femur hip thighbend legupper leg:0.4",
    "shin": "shin leg lowerleg calf tibia knee lowleg loleg leglower crus",
    "foot": "foot ankle talus:0.9",
    "toes": "toe toes toebase ball football foot:0.3 bigtoe:0.9",
}
_WORDS = {
    kind: {word: float(share or 1) for word, _, share in (w.partition(":") for w in words.split())}
    for kind, words in _NAMED.items()
}
#: Words of fingers; a name that holds one is of that finger.
FINGERS = {
    "thumb": "thumb",
    "index": "index",
    "middle": "middle",
    "mid": "middle",
    "ring": "ring",
    "pinky": "pinky",
    "little": "pinky",
    "finger": "fingers",
    "fingers": "fingers",
}
#: 3ds Max Biped counts its fingers from the thumb: Finger0, Finger01, Finger02, Finger1, ...
_BIPED_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
#: Words of joints that carry no part of the body: tips, twist bones, control rigs, faces, clothes.
_HELPER_WORDS = (
    "end nub tip top site effector rigmesh mesh twist roll ik fk pole target ctrl control helper sec "
    "adj eye jaw hair skirt breast bust tongue brow eyebrow lip cheek ear nose weapon gun prop attach "
    "socket cloth tail hat holster corrective correctiveroot mch org interaction center hipjoint "
    "buttock lid eyelid face teeth"
)
_HELPERS = frozenset(_HELPER_WORDS.split())
#: Words that say nothing about the part.
_NOISE = frozenset(
    ("j", "bip", "biped", "def", "c", "valve", "valvebiped", "jnt", "bone", "b", "skel", "avg", "smplhf")
)
_KNOWN = frozenset(w for words in _WORDS.values() for w in words) | _HELPERS | frozenset(FINGERS)


@dataclass(frozen=True)
class NameWords:
    """What a joint's name says.

    side: "left", "right" or "". core: its words joined, without side, prefix and numbers. tokens: the
    same words apart. number: its last number as it is written, or "". helper: it is no part of the body.
    """

    side: str
    core: str
    tokens: tuple[str, ...]
    number: str
    helper: bool

    def score(self, kind: str) -> float:
        """How clearly the name says `kind`: 1 without doubt, 0 not at all."""
        return 0.0 if self.helper else float(_WORDS.get(kind, {}).get(self.core, 0.0))

    @property
    def finger(self) -> str:
        """Which finger the name says, or ""."""
        if self.helper:
            return ""
        if self.core == "finger" and self.number:
            first = int(self.number[0])
            return _BIPED_FINGERS[first] if first < 5 else "fingers"
        found = (FINGERS[t] for t in self.tokens if t in FINGERS)
        return next(found, "fingers" if self.core == "fingerbase" else "")


@cache
def name_words(name: str) -> NameWords:
    """The words in a joint's name: "mixamorig:LeftUpLeg" is left and upleg, "lfemur" left and femur.

    Blender's exports may put the armature's name before it ("Armature_Hips", "Armature|Hips").
    """
    text = re.split(r"[:|]", name)[-1]
    text = re.sub(r"^armature(?:[._]?\d+)?[_. -](?=.)", "", text, flags=re.IGNORECASE)
    text = re.sub(r"^(mixamorig|character|cc_base)\d*_?(?=.)", "", text, flags=re.IGNORECASE)
    # Character Creator calls its necks so; they are no twist bones.
    text = re.sub(r"^NeckTwist", "Neck", text)
    raw = [t.lower() for t in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", text)]
    if len(raw) > 1 and raw[0] in ("joint", "m", "f"):
        raw = raw[1:]
    numbers = [t for t in raw if t.isdigit()]
    side, tokens = "", []
    for token in (t for t in raw if not t.isdigit()):
        found, rest = _side_of(token)
        side = side or found
        tokens += [rest] if rest else []
    bare = [t for t in tokens if t not in _NOISE]
    core = "".join(bare)
    helper = core in _HELPERS or any(t in _HELPERS for t in tokens)
    return NameWords(side, core, tuple(bare), numbers[-1] if numbers else "", helper)


#: What stands between a rig's name and a joint's, and how many joints must share the rig's name.
_BREAKS, _SHARED = "_.:|- ", 5


def without_rig(names: Sequence[str]) -> tuple[str, ...]:
    """Joints' names without the rig's name before each of them ("Armature_hips", "Hero.001_spine").

    A joint that is called like the rig keeps its name.
    """
    below = [n for n in names if not all(other.startswith(n) for other in names)]
    if len(below) < _SHARED:
        return tuple(names)
    shared = os.path.commonprefix(below)  # noqa: RUF071  (letters are wanted)
    cut = max(shared.rfind(mark) for mark in _BREAKS) + 1
    if not cut or name_words(shared[:cut]).core in _KNOWN:
        return tuple(names)
    return tuple(n[cut:] if n in below and len(n) > cut else n for n in names)


def _side_of(token: str) -> tuple[str, str]:
    """The side that a word states, and what is left of the word."""
    for side, letter in (("left", "l"), ("right", "r")):
        if token in (side, letter):
            return side, ""
        for start in (side, letter):
            rest = token.removeprefix(start)
            if rest != token and rest in _KNOWN and token not in _KNOWN:
                return side, rest
    return "", token


_SIDED = ("Left{}", "Right{}")


def _both(pattern: tuple[str, str], parts: str) -> frozenset[str]:
    return frozenset(p.format(part) for part in parts.split() for p in pattern)


_ARM, _UPLEG = "Shoulder Arm ForeArm Hand", "UpLeg Leg Foot"
_SMPL_SIDED = "Hip Knee Ankle Foot Collar Shoulder Elbow Wrist"
#: Names that mark the maker of a skeleton, without prefix such as "mixamorig:".
CONVENTIONS: dict[str, frozenset[str]] = {
    "Mixamo or MotionBuilder": _both(_SIDED, f"{_ARM} {_UPLEG} ToeBase")
    | {"Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"},
    "LAFAN1": _both(_SIDED, f"{_ARM} {_UPLEG} Toe")
    | {"Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"},
    "CMU (ASF)": _both(
        ("l{}", "r{}"),
        "hipjoint femur tibia foot toes clavicle humerus radius wrist hand fingers thumb",
    )
    | {"root", "lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head"},
    "CMU (BVH, MotionBuilder)": _both(_SIDED, f"{_ARM} {_UPLEG} ToeBase FingerBase")
    | _both(("L{}", "R{}"), "HipJoint Fingers Thumb")
    | {"Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head"},
    "CMU (BVH, 3ds Max)": _both(_SIDED, "Hip Knee Ankle Toe Collar Shoulder Elbow Wrist")
    | _both(("L{}", "R{}"), "HipJoint Fingers Thumb")
    | {"Hips", "lowerback", "Chest", "Chest2", "lowerneck", "Neck", "Head", "lhand", "rhand"},
    "CMU (BVH, Poser)": _both(("l{}", "r{}"), "Collar Shldr ForeArm Hand Buttock Thigh Shin Foot")
    | {"hip", "abdomen", "chest", "neck", "head"},
    "Bandai Namco": _both(
        ("{}_L", "{}_R"), "Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot Toes"
    )
    | {"joint_Root", "Hips", "Spine", "Chest", "Neck", "Head"},
    "SMPL": _both(("L_{}", "R_{}"), f"{_SMPL_SIDED} Hand")
    | {"Pelvis", "Spine1", "Spine2", "Spine3", "Neck", "Head"},
    "SMPL-X": _both(("left_{}", "right_{}"), _SMPL_SIDED.lower())
    | {"pelvis", "spine1", "spine2", "spine3", "neck", "head"},
    "Unreal mannequin": _both(("{}_l", "{}_r"), "clavicle upperarm lowerarm hand thigh calf foot ball")
    | {"root", "pelvis", "spine_01", "spine_02", "spine_03", "neck_01", "head"},
    "VRM (VRoid)": _both(
        ("J_Bip_L_{}", "J_Bip_R_{}"), "Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot ToeBase"
    )
    | {f"J_Bip_C_{x}" for x in ("Hips", "Spine", "Chest", "UpperChest", "Neck", "Head")},
    "VRM (humanoid bones)": _both(
        ("left{}", "right{}"), "Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot Toes"
    )
    | {"hips", "spine", "chest", "upperChest", "neck", "head"},
    "3ds Max Biped": _both(
        ("Bip01 L {}", "Bip01 R {}"), "Clavicle UpperArm Forearm Hand Thigh Calf Foot Toe0"
    )
    | {f"Bip01 {x}" for x in ("Pelvis", "Spine", "Spine1", "Spine2", "Neck", "Head")},
    "Rigify": _both(("{}.L", "{}.R"), "shoulder upper_arm forearm hand thigh shin foot toe")
    | {"spine", "spine.001", "spine.002", "spine.003"},
    "Xsens": _both(_SIDED, "Hip Knee Ankle Toe Collar Shoulder Elbow Wrist")
    | {"Hips", "Chest", "Chest2", "Chest3", "Chest4", "Neck", "Head"},
    "DeepMimic": _both(("left_{}", "right_{}"), "hip knee ankle shoulder elbow wrist")
    | {"root", "chest", "neck"},
}


def convention_of(names: tuple[str, ...]) -> tuple[str, int]:
    """The naming convention of these names ("" if none), and how many of them it has."""
    found = _best_convention(names)
    # A rig's name before the joints' hides a convention; in some it is part of one ("Bip01 Spine").
    return found if found[0] else _best_convention(without_rig(names))


def _best_convention(names: tuple[str, ...]) -> tuple[str, int]:
    bare = {
        re.sub(r"^(mixamorig\d*_?|Character\d*_|DEF-)(?=.)", "", n.rsplit(":", 1)[-1]) for n in names
    }
    parts = {n for n in bare if not name_words(n).helper and not name_words(n).finger}
    ranked = {
        # How many joints agree, against all that either side has.
        maker: (len(bare & marks) / len(parts | marks), len(bare & marks))
        for maker, marks in CONVENTIONS.items()
    }
    maker = max(ranked, key=lambda m: ranked[m])
    share, count = ranked[maker]
    return (maker, count) if share >= 0.6 else ("", count)
