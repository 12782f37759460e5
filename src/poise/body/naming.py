"""What a joint's name says: its side, its bare part, whether it is a helper; over all common rigs."""

from __future__ import annotations

import re
from collections.abc import Sequence

from poise.motion import Skeleton

#: Words of the limbs' parts, the surest first; several rigs call the same joint after the bone that
#: starts there or after the joint itself.
LIMBS: dict[str, tuple[str, ...]] = {
    "thigh": ("upleg", "upperleg", "thigh", "femur", "hip"),
    "shin": ("lowerleg", "shin", "calf", "tibia", "knee", "leg"),
    "foot": ("foot", "ankle", "talus"),
    "upper_arm": ("upperarm", "humerus", "shldr", "arm", "shoulder"),
    "forearm": ("forearm", "lowerarm", "radius", "elbow"),
    "hand": ("hand", "wrist"),
}
_CORES = (
    *("femur", "tibia", "foot", "toes", "toe", "clavicle", "humerus", "radius", "wrist", "hand"),
    *("fingers", "thumb", "hipjoint", "hip", "knee", "ankle", "shoulder", "elbow", "collar", "shldr"),
    *("forearm", "thigh", "shin", "buttock", "arm", "leg", "upleg", "upperarm", "lowerarm", "upperleg"),
    *("lowerleg", "calf", "toebase", "fingerbase"),
)
_SIDES = {"l": "left", "r": "right"}
#: Joints that help a rig or its skin and are no joint of the body. The words stand alone in a name
#: ("ik_foot_l", "RightArmTwist"); others may stand anywhere.
_HELPER_WORDS = {"ik", "fk", "pole", "ctrl", "vb", "nub", "end", "site", "helper", "roll", "twist"}
_HELPER_WORDS |= {
    "target",
    "socket",
    "attach",
    "weapon",
    "prop",
    "effector",
    "mesh",
    "jiggle",
    "corrective",
}
_HELPER_PARTS = ("rigmesh", "twist", "endsite", "_end")


def plain_name(name: str) -> tuple[str, str]:
    """The side ("left", "right", "") and the bare lower-case part of a joint's name."""
    bare = re.sub(r"^(character\d*_|mixamorig\d*_|.*[:|])", "", name, flags=re.IGNORECASE)
    # "thigh.L.001" is Blender's copy of "thigh.L".
    bare = re.sub(r"\.\d{3}$", "", bare)
    text = bare.lower()
    for side, signs in (("left", ("left", "左")), ("right", ("right", "右"))):
        for sign in signs:
            if sign in text:
                return side, text.replace(sign, "").strip("_. -")
    match = re.match(r"^(.*)[_. -]([lr])$", text)
    if match:
        return _SIDES[match.group(2)], match.group(1)
    match = re.match(r"^.+[_. -]([lr])[_. -](.+)$", text)
    if match:
        return _SIDES[match.group(1)], match.group(2)
    # "lShldrBend": a small letter before a capital one.
    if re.match(r"^[lr][A-Z][a-z]", bare):
        return _SIDES[text[0]], text[1:]
    match = re.match(r"^([lr])[_. -]?(.+)$", text)
    if match and any(match.group(2).rstrip("0123456789") == core for core in _CORES):
        return _SIDES[match.group(1)], match.group(2)
    return "", text


def words(name: str) -> list[str]:
    """The words of a name: "RightArmTwist_01" is right, arm, twist."""
    split = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return [w for w in re.split(r"[^A-Za-z]+", split.lower()) if w]


def is_helper(name: str) -> bool:
    """Whether a joint helps the rig (IK targets, twist bones, skin meshes, ends) and is no body part."""
    low = name.lower()
    return any(p in low for p in _HELPER_PARTS) or not _HELPER_WORDS.isdisjoint(words(name))


def first_named(skeleton: Skeleton, kind: str, side: str) -> int | None:
    """The joint nearest the root that is called a `kind` ("foot", "hand") of that side."""
    for j, name in enumerate(skeleton.names):
        found, core = plain_name(name)
        if found == side and not is_helper(name) and any(w in core for w in LIMBS[kind]):
            return j
    return None


def limb_named(
    skeleton: Skeleton, line: Sequence[int], kinds: tuple[str, str, str]
) -> tuple[int, int, int] | None:
    """The three joints of a limb on `line` (trunk to end), by name where more than three are no
    helpers; None where fewer are.

    A line that ends root, thigh, shin, foot is settled by its last three; in longer ones, the words
    of `LIMBS` decide where they agree with that order.
    """
    own = [j for j in line if not is_helper(skeleton.names[j])]
    if len(own) < 3:
        return None
    cores = {j: plain_name(skeleton.names[j])[1] for j in own}
    upper = _called(own[:-2], cores, LIMBS[kinds[0]])
    if upper is not None:
        lower = _called(own[own.index(upper) + 1 : -1], cores, LIMBS[kinds[1]])
        if lower is not None:
            return upper, lower, own[-1]
    return own[-3], own[-2], own[-1]


def _called(line: Sequence[int], cores: dict[int, str], known: tuple[str, ...]) -> int | None:
    """The joint of `line` with the surest of the `known` words alone or at its start."""
    for word in known:
        for j in line:
            if re.match(rf"^(.*[_. -])?{word}(bend)?[_. -]?\d*$", cores[j]):
                return j
    return None


def is_neck(name: str) -> bool:
    """Whether a joint is called a neck."""
    side, core = plain_name(name)
    return not side and "neck" in core and "rigmesh" not in core


def is_head(name: str) -> bool:
    """Whether a joint is called the head itself, and not something on it."""
    side, core = plain_name(name)
    return (
        not side and re.fullmatch(r"(.*[_. -])?(head|skull)", core) is not None and not is_helper(name)
    )
