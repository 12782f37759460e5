"""Which joint is which part of a human body, by name and by place in the tree."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

from poise.errors import PoiseError
from poise.motion import Skeleton

_FOOT = ("foot", "ankle", "talus")
_HAND = ("hand", "wrist")
_HEAD = ("head",)
_NECK = ("neck",)
_CORES = (
    *("femur", "tibia", "foot", "toes", "toe", "clavicle", "humerus", "radius", "wrist", "hand"),
    *("fingers", "thumb", "hipjoint", "hip", "knee", "ankle", "shoulder", "elbow", "collar", "shldr"),
    *("forearm", "thigh", "shin", "buttock", "arm", "leg", "upleg", "upperarm", "lowerarm", "upperleg"),
    *("lowerleg", "calf", "toebase", "fingerbase"),
)


@dataclass(frozen=True)
class Part:
    """One joint's place in the body.

    kind: pelvis, spine, neck, head, clavicle, upper_arm, forearm, hand, thigh, shin, foot.
    side: "left", "right" or "".
    """

    joint: int
    kind: str
    side: str = ""


@dataclass(frozen=True)
class Anatomy:
    """The parts found in a skeleton; joints that are no part ride rigidly on their nearest ancestor.

    parts: depth first, as MuJoCo numbers bodies; the first is the pelvis. toes: first joint below each
    foot, by side, where there is one.
    """

    parts: tuple[Part, ...]
    toes: tuple[tuple[str, int], ...]

    def without(self, joints: Iterable[int]) -> Anatomy:
        """The anatomy with some joints riding rigidly on their ancestors."""
        gone = set(joints)
        return replace(self, parts=tuple(p for p in self.parts if p.joint not in gone))

    def of(self, kind: str, side: str = "") -> tuple[int, ...]:
        """Joint indices of one kind (and side)."""
        return tuple(p.joint for p in self.parts if p.kind == kind and (not side or p.side == side))


def plain_name(name: str) -> tuple[str, str]:
    """The side ("left", "right", "") and the bare lower-case part of a joint's name."""
    text = re.sub(r"^(character\d*_|.*:)", "", name.lower())
    for side in ("left", "right"):
        if side in text:
            return side, text.replace(side, "").strip("_. ")
    match = re.match(r"^(.*)[_.]([lr])$", text) or None
    if match:
        return {"l": "left", "r": "right"}[match.group(2)], match.group(1)
    match = re.match(r"^.+[_. ]([lr])[_. ](.+)$", text)
    if match:
        return {"l": "left", "r": "right"}[match.group(1)], match.group(2)
    match = re.match(r"^([lr])[_.]?(.+)$", text)
    if match and any(match.group(2).rstrip("0123456789") == core for core in _CORES):
        return {"l": "left", "r": "right"}[match.group(1)], match.group(2)
    return "", text


def _path(skeleton: Skeleton, top: int, bottom: int) -> list[int]:
    """Joints from just below `top` down to `bottom`, inclusive."""
    out: list[int] = []
    j = bottom
    while j not in (top, -1):
        out.append(j)
        j = skeleton.parents[j]
    return out[::-1]


def _depth_first(skeleton: Skeleton) -> list[int]:
    """All joints, each one's whole subtree before its next sibling."""
    out, stack = [], [0]
    while stack:
        out.append(stack.pop())
        stack += reversed(skeleton.children(out[-1]))
    return out


def _ancestors(skeleton: Skeleton, joint: int) -> list[int]:
    return [*_path(skeleton, -1, joint)][::-1]


def _common(skeleton: Skeleton, a: int, b: int) -> int:
    line = set(_ancestors(skeleton, a))
    return next(j for j in _ancestors(skeleton, b) if j in line)


def _first(skeleton: Skeleton, words: tuple[str, ...], side: str) -> int | None:
    """The joint nearest the root whose bare name holds one of `words` and is of that side."""
    for j, name in enumerate(skeleton.names):
        found, core = plain_name(name)
        if found == side and "rigmesh" not in core and any(w in core for w in words):
            return j
    return None


def find_anatomy(skeleton: Skeleton) -> Anatomy:
    """The body parts of a human skeleton.

    Raises:
        PoiseError: where a foot or a hand cannot be told from the joints' names.
    """
    ends: dict[str, int] = {}
    for side in ("left", "right"):
        for label, words in (("foot", _FOOT), ("hand", _HAND)):
            joint = _first(skeleton, words, side)
            if joint is None:
                raise PoiseError(
                    f"no {side} {label} was found among the joints {', '.join(skeleton.names)}",
                    skeleton.source.path,
                    f"Name the joint '{side.capitalize()}{label.capitalize()}' or similar",
                )
            ends[f"{side} {label}"] = joint
    pelvis = _common(skeleton, ends["left foot"], ends["right foot"])
    chest = _common(skeleton, ends["left hand"], ends["right hand"])
    # Where the hips and the spine hang side by side, the joint that carries both is the pelvis.
    pelvis = _common(skeleton, pelvis, chest)
    kinds: dict[int, tuple[str, str]] = {pelvis: ("pelvis", "")}
    for j in _path(skeleton, pelvis, chest):
        kinds[j] = ("spine", "")
    toes: list[tuple[str, int]] = []
    for side in ("left", "right"):
        foot, hand = ends[f"{side} foot"], ends[f"{side} hand"]
        leg, arm = _path(skeleton, pelvis, foot), _path(skeleton, chest, hand)
        if len(leg) < 3 or len(arm) < 3:
            short, line = ("leg", leg) if len(leg) < 3 else ("arm", arm)
            raise PoiseError(
                f"the {side} {short} has {len(line)} joints "
                f"({', '.join(skeleton.names[j] for j in line)}) and needs at least 3",
                skeleton.source.path,
            )
        kinds[leg[-3]], kinds[leg[-2]], kinds[foot] = ("thigh", side), ("shin", side), ("foot", side)
        kinds[arm[-3]], kinds[arm[-2]], kinds[hand] = (
            ("upper_arm", side),
            ("forearm", side),
            ("hand", side),
        )
        if len(arm) > 3:
            kinds[arm[-4]] = ("clavicle", side)
        below = [c for c in skeleton.children(foot) if "rigmesh" not in skeleton.names[c].lower()]
        if below:
            toes.append((side, below[0]))
    for j, name in enumerate(skeleton.names):
        side, core = plain_name(name)
        if j in kinds or side or chest not in _ancestors(skeleton, j):
            continue
        if any(w in core for w in _NECK) and "rigmesh" not in core:
            kinds[j] = ("neck", "")
        elif core in _HEAD:
            kinds[j] = ("head", "")
    parts = tuple(Part(j, *kinds[j]) for j in _depth_first(skeleton) if j in kinds)
    return Anatomy(parts, tuple(toes))
